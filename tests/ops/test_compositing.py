"""Compositing: light is conserved, and the fast version is the plain one."""

import math

import numpy as np
import pytest
import torch

from sharpfield.core.seed import generator
from sharpfield.ops import _dispatch
from sharpfield.ops import compositing as ops


def rays(*shape: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    g = generator(0, 0, "composite test")
    density = 5 * torch.rand(*shape, generator=g, dtype=dtype)
    return density, torch.rand(*shape, generator=g, dtype=dtype)


def test_opaque_end_makes_weights_sum_to_one() -> None:
    weights = ops.weigh(*rays(2, 3, 20), opaque_end=True)
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, 3, dtype=torch.float64))


def test_opacity_of_a_uniform_medium_does_not_depend_on_the_samples() -> None:
    for samples in (1, 7, 100):
        density = torch.full((samples,), 2.0, dtype=torch.float64)
        weights = ops.weigh(density, torch.full_like(density, 0.5 / samples))
        assert math.isclose(weights.sum(), 1 - math.exp(-1), rel_tol=1e-8)


def test_nothing_is_seen_behind_a_wall() -> None:
    density = torch.tensor([0.0, 1e9, 5.0])
    weights = ops.weigh(density, torch.ones(3))
    torch.testing.assert_close(weights, torch.tensor([0.0, 1.0, 0.0]))


def slow(density: np.ndarray, delta: np.ndarray, opaque_end: bool) -> list[float]:
    weights, passed = [], 1.0
    for j in range(len(density)):
        alpha = 1 - math.exp(-density[j] * delta[j])
        if opaque_end and j == len(density) - 1:
            alpha = 1.0
        weights.append(alpha * passed)
        passed *= 1 - alpha + 1e-10
    return weights


@pytest.mark.parametrize("opaque_end", [False, True])
@pytest.mark.parametrize("version", ["reference", "fast"])
def test_weights_match_a_slow_loop(version: str, opaque_end: bool) -> None:
    density, delta = rays(3, 12)
    with _dispatch.using(version):
        found = ops.weigh(density, delta, opaque_end=opaque_end)
    expected = [slow(a, b, opaque_end) for a, b in zip(density.numpy(), delta.numpy(), strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("opaque_end", [False, True])
@pytest.mark.parametrize("version", ["reference", "fast"])
def test_gradients(version: str, opaque_end: bool) -> None:
    inputs = tuple(tensor.requires_grad_() for tensor in rays(2, 2, 6))
    with _dispatch.using(version):
        assert torch.autograd.gradcheck(lambda a, b: ops.weigh(a, b, opaque_end=opaque_end), inputs)


@pytest.mark.parametrize("opaque_end", [False, True])
def test_fast_equals_reference_also_where_light_is_gone(opaque_end: bool) -> None:
    density, delta = rays(50, 64, dtype=torch.float32)
    density = density * torch.logspace(-6, 6, 50)[:, None]
    pull = torch.rand(50, 64, generator=generator(0, 0, "pull"))
    found = {}
    for version in ("reference", "fast"):
        inputs = density.clone().requires_grad_(), delta.clone().requires_grad_()
        with _dispatch.using(version):
            weights = ops.weigh(*inputs, opaque_end=opaque_end)
        found[version] = weights.detach(), *torch.autograd.grad((weights * pull).sum(), inputs)
    for plain, quick in zip(found["reference"], found["fast"], strict=True):
        torch.testing.assert_close(quick, plain, rtol=2e-5, atol=1e-6)


def test_composite_gathers_everything_by_weight() -> None:
    density, delta = rays(2, 3, 5)
    colour = torch.rand(2, 3, 5, 4, dtype=torch.float64, generator=generator(0, 0, "colour"))
    depth = delta.cumsum(-1)
    seen = ops.composite(density, delta, colour, depth, opaque_end=True)
    weights = ops.weigh(density, delta, opaque_end=True)
    torch.testing.assert_close(seen.rgb, (weights[..., None] * colour).sum(-2))
    torch.testing.assert_close(seen.depth, (weights * depth).sum(-1))
    torch.testing.assert_close(seen.opacity, weights.sum(-1))
    torch.testing.assert_close(seen.weights, weights)


def test_skipped_samples_count_as_black() -> None:
    weights = ops.weigh(*rays(6, 5))
    colour = torch.rand(6, 5, 3, dtype=torch.float64, generator=generator(0, 0, "colour"))
    keep = weights > 0.1
    assert keep.any() and not keep.all()
    found = ops.gather_kept(weights, keep.flatten().nonzero()[:, 0], colour[keep])
    torch.testing.assert_close(found, ops.gather(weights * keep, colour))
    nothing = torch.zeros(0, dtype=torch.int64)
    assert not ops.gather_kept(weights, nothing, colour[:0, 0]).any()


def test_gradient_of_kept_samples() -> None:
    weights = rays(3, 5)[0].requires_grad_()
    kept = (weights > 2).flatten().nonzero()[:, 0]
    colour = torch.rand(len(kept), 3, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda w, c: ops.gather_kept(w, kept, c), (weights, colour))


def test_gaps_reach_to_the_next_sample_in_units_of_the_direction() -> None:
    depth = torch.tensor([[0.0, 1.0, 3.0]])
    found = ops.gaps(depth, torch.tensor([2.0]), last=10.0)
    assert found.tolist() == [[2.0, 4.0, 20.0]]


def test_endless_last_sample_is_opaque_if_there_is_anything_and_clear_if_not() -> None:
    delta = ops.gaps(torch.tensor([0.0, 1.0]), torch.tensor(1.0))
    assert ops.weigh(torch.tensor([0.0, 1e-3]), delta).tolist() == [0, 1]
    assert ops.weigh(torch.tensor([0.0, 0.0]), delta).tolist() == [0, 0]


def test_no_rays() -> None:
    none = torch.zeros(0, 5)
    assert ops.weigh(none, none).shape == (0, 5)
