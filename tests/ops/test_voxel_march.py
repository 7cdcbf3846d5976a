"""Marching through a grid: against a slow loop, and the light that is left over."""

import math

import pytest
import torch

from sharpfield.core.errors import ShapeError
from sharpfield.ops._dispatch import using
from sharpfield.ops.voxel_march import DENSITY_SHIFT, march_voxels


def trilinear(grid: torch.Tensor, point: list[float]) -> torch.Tensor | None:
    """Values between cells, one neighbour at a time; None outside."""
    if max(abs(x) for x in point) > 1:
        return None
    total = torch.zeros(4)
    places = [(x + 1) / 2 * (n - 1) for x, n in zip(point, grid.shape[2::-1], strict=True)]
    for corner in range(8):
        weight, cell = 1.0, []
        for axis, place in enumerate(places):
            low = min(int(place), grid.shape[2 - axis] - 2)
            up = corner >> axis & 1
            weight *= place - low if up else 1 - (place - low)
            cell.append(low + up)
        total += weight * grid[cell[2], cell[1], cell[0]]
    return total


def slow(grid: torch.Tensor, origin: list[float], direction: list[float], place: list[float]):
    """One ray without an opaque end, in plain Python."""
    clear, light = 1.0, [0.0] * 5
    for z in place:
        found = trilinear(grid, [o + z * d for o, d in zip(origin, direction, strict=True)])
        if found is None:
            continue
        alpha = 1 - math.exp(-math.log1p(math.exp(float(found[0]) + DENSITY_SHIFT)))
        for i, value in enumerate([*torch.sigmoid(found[1:]).tolist(), z, 1.0]):
            light[i] += clear * alpha * value
        clear *= 1 - alpha
    return light


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_equals_a_slow_loop(choice: str) -> None:
    made = torch.Generator().manual_seed(0)
    grid = 4 * torch.randn(4, 5, 6, 4, generator=made)
    origin = torch.rand(7, 3, generator=made) - 0.8
    direction = torch.rand(7, 3, generator=made) + 0.2
    place = torch.rand(7, 9, generator=made).sort(-1).values
    with using(choice):
        seen = march_voxels(origin, direction, place, [grid], opaque_end=False)
    for ray in range(7):
        expected = slow(grid, origin[ray].tolist(), direction[ray].tolist(), place[ray].tolist())
        assert seen[ray].tolist() == pytest.approx(expected, abs=2e-5)


def test_an_opaque_end_takes_all_light_that_is_left() -> None:
    grid = torch.zeros(3, 3, 3, 4)
    place = torch.linspace(0, 1, 10).expand(2, -1).contiguous()
    ahead = torch.tensor([[0.0, 0.0, 1.8]]).expand(2, 3).contiguous()
    start = torch.tensor([[0.0, 0.0, -0.9]]).expand(2, 3).contiguous()
    open_end = march_voxels(start, ahead, place, [grid], opaque_end=False)
    closed = march_voxels(start, ahead, place, [grid], opaque_end=True)
    assert float(open_end[0, 4]) == pytest.approx(1 - (1 / (1 + math.exp(DENSITY_SHIFT))) ** 10)
    assert closed[:, 4].tolist() == pytest.approx([1.0, 1.0], abs=1e-5)


def test_gradients_do_not_depend_on_threads() -> None:
    made = torch.Generator().manual_seed(1)
    grid = torch.randn(5, 6, 7, 4, generator=made).requires_grad_()
    rays = (torch.rand(50, 3, generator=made) - 0.5, torch.rand(50, 3, generator=made))
    place = torch.rand(50, 12, generator=made).sort(-1).values
    before, gradients = torch.get_num_threads(), []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        (gradient,) = torch.autograd.grad(march_voxels(*rays, place, [grid]).sum(), grid)
        gradients.append(gradient)
    torch.set_num_threads(before)
    assert torch.equal(*gradients)


@pytest.mark.parametrize("opaque_end", [True, False])
def test_gradients_of_the_grids_are_those_of_the_definition(opaque_end: bool) -> None:
    origin, direction, place, grids, *_ = march_voxels.example(torch.Generator().manual_seed(3), 4)
    found = {}
    for choice in ("reference", "fast"):
        leaves = [grid.clone().requires_grad_() for grid in grids]
        with using(choice):
            seen = march_voxels(origin, direction, place, leaves, opaque_end=opaque_end)
        loss = (seen * torch.arange(1.0, 6.0)).sin().sum()
        found[choice] = torch.autograd.grad(loss, leaves)
    for ours, wanted in zip(found["fast"], found["reference"], strict=True):
        assert torch.allclose(ours, wanted, atol=2e-5 * float(wanted.abs().max()))


def test_moving_grids_need_times() -> None:
    origin, direction, depths, static, moving, rows, _ = march_voxels.example(torch.Generator(), 1)
    with pytest.raises(ShapeError, match="need the time of each ray"):
        march_voxels(origin, direction, depths, static, moving, rows)
