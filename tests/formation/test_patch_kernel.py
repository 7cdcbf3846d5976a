"""Kernels of patches: the published values, the right choice, and nothing lost at edges."""

import pytest
import torch
from torch import Tensor

from sharpfield.formation.patch_kernel import (
    ChosenKernel,
    LearnedKernel,
    best_match,
    convolve,
    convolve_all,
    motion_kernels,
    unfold,
)

ROUNDED = 1e-4
"""Published values have four decimals."""


def by_name(kind: str, distance: int, degrees: int) -> Tensor:
    return motion_kernels(9, (distance,), kind=kind)[degrees // 45]


@pytest.mark.parametrize("kind", ["outward", "through", "both"])
def test_kernels_sum_to_one_and_are_as_many_as_published(kind: str):
    kernels = motion_kernels(kind=kind)
    assert len(kernels) == {"outward": 24, "through": 12, "both": 36}[kind]
    assert torch.allclose(kernels.sum((1, 2)), torch.ones(len(kernels)))


@pytest.mark.parametrize("distance", [1, 2, 4])
@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_upright_strokes_are_exact_lines(distance: int, degrees: int):
    kernel = by_name("outward", distance, degrees)
    step = {0: (-1, 0), 90: (0, -1), 180: (1, 0), 270: (0, 1)}[degrees]  # up, then to the left
    expected = torch.zeros(9, 9)
    for i in range(distance + 1):
        expected[4 + i * step[0], 4 + i * step[1]] = 1 / (distance + 1)
    assert torch.allclose(kernel, expected, atol=1e-6)


GOLDEN = {
    ("outward", 1): {(3, 3): 0.2565, (3, 4): 0.1215, (4, 4): 0.4321, (4, 5): 0.0342},
    ("outward", 2): {
        (2, 2): 0.0551,
        (2, 3): 0.0724,
        (3, 3): 0.2941,
        (4, 4): 0.2941,
        (3, 4): 0.0827,
        (4, 5): 0.0233,
    },
    ("outward", 4): {
        (0, 1): 0.0031,
        (1, 1): 0.1332,
        (2, 2): 0.1776,
        (3, 3): 0.1776,
        (4, 4): 0.1776,
        (1, 2): 0.0499,
        (2, 3): 0.0499,
        (3, 4): 0.0499,
        (4, 5): 0.0140,
    },
    ("through", 1): {(3, 3): 0.1792, (5, 5): 0.1792, (4, 4): 0.3019, (3, 4): 0.0849},
    ("through", 4): {
        (1, 1): 0.0754,
        (2, 2): 0.1005,
        (6, 6): 0.1005,
        (3, 4): 0.0283,
        (0, 1): 0.0018,
    },
}


@pytest.mark.parametrize(("name", "values"), GOLDEN.items(), ids=str)
def test_slanted_strokes_have_the_published_values(name: tuple[str, int], values: dict):
    kernel = by_name(*name, 45)
    for (row, column), value in values.items():
        assert kernel[row, column] == pytest.approx(value, abs=ROUNDED), (row, column)
        assert kernel[column, row] == pytest.approx(value, abs=ROUNDED), (column, row)


def test_directions_are_closed_under_half_turns():
    kernels = motion_kernels(kind="outward")
    for kernel in kernels:
        turned = kernel.flip(0, 1)
        assert (kernels - turned).abs().amax((1, 2)).min() < 0.02


def test_unfolding_agrees_with_a_slow_loop():
    patches = torch.randn(2, 4, 5, 3)
    around = unfold(patches, 3)
    for y in range(4):
        for x in range(5):
            for i, (dy, dx) in enumerate((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)):
                inside = 0 <= y + dy < 4 and 0 <= x + dx < 5
                wanted = patches[:, y + dy, x + dx] if inside else torch.zeros(2, 3)
                assert torch.equal(around[:, y, x, :, i], wanted)


def test_one_kernel_each_is_the_diagonal_of_all():
    patches, kernels = torch.randn(4, 8, 8, 3), torch.randn(4, 5, 5)
    every = convolve_all(patches, kernels)
    diagonal = every[torch.arange(4), torch.arange(4)]
    assert torch.allclose(convolve(patches, kernels), diagonal, atol=1e-5)


def test_the_kernel_that_blurred_is_found_and_sharp_stays_sharp():
    kernels = motion_kernels()
    sharp = torch.rand(37, 8, 8, 3, generator=torch.Generator().manual_seed(1))
    known = torch.ones(37, 8, 8)
    blur = ChosenKernel(kernels)
    recorded = sharp.clone()
    share = convolve(known[:36, ..., None], kernels)
    recorded[:36] = convolve(sharp[:36], kernels) / share
    found = blur(sharp, recorded, known)
    assert torch.allclose(found, recorded, atol=1e-5)
    assert torch.equal(found[36], sharp[36])


def test_constant_light_stays_constant_also_beside_unknown_pixels():
    sharp = torch.full((5, 8, 8, 3), 0.4)
    known = torch.ones(5, 8, 8)
    known[:, 2:4] = 0
    sharp = torch.where(known[..., None] > 0, sharp, 9.0)
    found = ChosenKernel(motion_kernels())(sharp, torch.rand(5, 8, 8, 3), known)
    assert torch.allclose(found[known > 0], torch.tensor(0.4), atol=1e-5)


def test_gradients_flow_through_the_choice_alone():
    sharp = torch.rand(3, 8, 8, 1, dtype=torch.float32, requires_grad=True)
    blur = ChosenKernel(motion_kernels())
    recorded = torch.rand(3, 8, 8, 1)
    blur(sharp, recorded, torch.ones(3, 8, 8)).sum().backward()
    assert sharp.grad is not None and sharp.grad.isfinite().all()


def test_the_best_match_is_the_least_difference():
    candidates = torch.stack([torch.full((2, 4, 4, 1), v) for v in (0.0, 0.5, 1.0)], 1)
    wanted = torch.tensor([0.9, 0.2])[:, None, None, None].expand(2, 4, 4, 1)
    assert best_match(candidates, wanted).tolist() == [2, 0]


@pytest.mark.parametrize("edge", ["keep", "divide", "still"])
def test_a_learned_kernel_begins_as_half_a_box_and_keeps_constant_light(edge: str):
    blur = LearnedKernel(8, seed=0, edge=edge)
    for parameter in blur.parameters():
        torch.nn.init.zeros_(parameter)
    sharp, known = torch.full((2, 8, 8, 3), 0.3), torch.ones(2, 8, 8)
    kernel = blur.kernels(sharp, sharp).detach()
    assert torch.allclose(kernel.sum((1, 2)), torch.ones(2))
    assert kernel[0, 4, 4] == pytest.approx(0.5 / 81 + 0.5, abs=1e-5)
    assert kernel[0, 0, 0] == pytest.approx(0.5 / 81, abs=1e-5)
    assert torch.allclose(blur(sharp, sharp, known), sharp, atol=1e-5)


def test_the_learned_network_has_the_published_size():
    assert sum(p.numel() for p in LearnedKernel(8, seed=0).parameters()) == 60_114
