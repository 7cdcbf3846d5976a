"""Sampling along rays goes where the light came from."""

import numpy as np
import pytest
import torch

from sharpfield.core.seed import generator
from sharpfield.ops import stepfun


def ray(samples: int = 9, rays: int = 4, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = generator(seed, 0, "stepfun test")
    edges = torch.rand(rays, samples + 1, generator=g, dtype=torch.float64).sort(-1).values
    return edges, torch.rand(rays, samples, generator=g, dtype=torch.float64)


def test_jitter_stays_in_its_bin_and_reaches_both_ends_of_it() -> None:
    depth = torch.tensor([[0.0, 1.0, 4.0]])
    low = stepfun.jitter(depth, torch.zeros(1, 3))
    high = stepfun.jitter(depth, torch.ones(1, 3))
    assert low.tolist() == [[0.0, 0.5, 2.5]] and high.tolist() == [[0.5, 2.5, 4.0]]


def test_new_points_follow_the_weights() -> None:
    edges, weights = ray(rays=1)
    g = generator(0, 0, "many")
    found = stepfun.invert(edges, weights, stepfun.random_positions([1], 200_000, g).double())
    counted, _ = np.histogram(found.numpy(), edges[0].numpy())
    expected = (weights / weights.sum()).numpy()[0]
    np.testing.assert_allclose(counted / counted.sum(), expected, atol=4e-3)


def test_inverse_cumulative_weight_matches_a_slow_loop() -> None:
    edges, weights = ray()
    position = stepfun.random_positions([4], 50, generator(1, 0, "u")).double()
    found = stepfun.invert(edges, weights, position)
    for r in range(4):
        total = np.concatenate([[0], np.cumsum(weights[r] / weights[r].sum())])
        expected = np.interp(position[r], total, edges[r])
        np.testing.assert_allclose(found[r], expected, atol=1e-9)


def slow_resample(depth: np.ndarray, weights: np.ndarray, positions: np.ndarray) -> list[float]:
    """The rule of the released NeRF, one number at a time."""
    bins = [(a + b) / 2 for a, b in zip(depth[:-1], depth[1:], strict=True)]
    pdf = [w + 1e-5 for w in weights[1:-1]]
    total = [0.0]
    for value in pdf:
        total.append(total[-1] + value / sum(pdf))
    found = []
    for u in positions:
        right = sum(value <= u for value in total)
        below, above = max(right - 1, 0), min(right, len(total) - 1)
        gap = total[above] - total[below]
        gap = 1.0 if gap < 1e-5 else gap
        found.append(bins[below] + (u - total[below]) / gap * (bins[above] - bins[below]))
    return found


@pytest.mark.parametrize("concentrated", [False, True])
def test_points_are_resampled_by_the_released_rule(concentrated: bool) -> None:
    depth, _ = ray(samples=8)
    weights = torch.rand(4, 9, generator=generator(2, 0, "w"), dtype=torch.float64)
    if concentrated:  # bins thinner than 1e-5 of the weight
        weights = torch.zeros(4, 9, dtype=torch.float64)
        weights[:, 4] = 100.0
    position = stepfun.even_positions([4], 16).double()
    found = stepfun.resample_points(depth, weights, position)
    for r in range(4):
        expected = slow_resample(depth[r].numpy(), weights[r].numpy(), position[r].numpy())
        np.testing.assert_allclose(found[r], expected, atol=1e-12)


def test_even_positions_include_both_ends() -> None:
    assert stepfun.even_positions([2], 3).tolist() == [[0.0, 0.5, 1.0]] * 2


def test_stratified_positions_have_one_in_each_bin() -> None:
    found = stepfun.stratified_positions([100], 7, generator(0, 0, "strata"))
    assert torch.equal((found * 7).long(), torch.arange(7).expand(100, 7))


def test_merge_sorts_and_tells_where_each_came_from() -> None:
    first, second = torch.tensor([[0.0, 2.0, 4.0]]), torch.tensor([[3.0, 2.0]])
    depth, order = stepfun.merge(first, second)
    assert depth.tolist() == [[0, 2, 2, 3, 4]] and order.tolist() == [[0, 1, 4, 3, 2]]
    value = torch.cat([first, second], -1)[..., None].expand(1, 5, 3)
    assert torch.equal(stepfun.take_along(value, order)[..., 0], depth)


def test_new_samples_carry_no_gradient() -> None:
    edges, weights = ray()
    weights.requires_grad_()
    position = stepfun.even_positions([4], 5).double()
    assert not stepfun.resample_points(edges[:, 1:], weights, position).requires_grad


def test_all_weight_at_the_ends_still_samples_inside_the_range() -> None:
    depth = torch.linspace(0, 1, 6)[None]
    weights = torch.tensor([[1.0, 0, 0, 0, 0, 1.0]])
    found = stepfun.resample_points(depth, weights, stepfun.even_positions([1], 9))
    assert found.min() >= 0 and found.max() <= 1 and torch.isfinite(found).all()
