"""Plane and line lookups: interpolation laws, a loop as oracle, golden sizes."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sharpfield.ops._dispatch import using
from sharpfield.ops.grid import (
    PAIRS,
    grid_shape,
    line_features,
    plane_features,
    plane_line_features,
    plane_line_mixture,
)

SHAPE = (5, 4, 6)
CHANNELS = (4, 2, 3)


@pytest.fixture(params=["reference", "fast"], autouse=True)
def version(request: pytest.FixtureRequest):
    with using(request.param):
        yield


def volume(dtype: torch.dtype = torch.float64) -> tuple[list[Tensor], list[Tensor]]:
    generator = torch.Generator().manual_seed(0)

    def values(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=dtype).requires_grad_()

    planes = [values(SHAPE[b], SHAPE[a], c) for (a, b, _), c in zip(PAIRS, CHANNELS, strict=True)]
    lines = [values(SHAPE[along], c) for (_, _, along), c in zip(PAIRS, CHANNELS, strict=True)]
    return planes, lines


def slow(point: np.ndarray, planes: list[np.ndarray], lines: list[np.ndarray]) -> np.ndarray:
    """Sum over all cells of hat function times feature: a cell outside does not exist."""
    place = [(x + 1) / 2 * (size - 1) for x, size in zip(point, SHAPE, strict=True)]

    def hat(axis: int, cell: int) -> float:
        return max(0.0, 1 - abs(place[axis] - cell))

    features = []
    for (a, b, along), plane, line in zip(PAIRS, planes, lines, strict=True):
        on_plane = np.zeros(plane.shape[2])
        for i, j in itertools.product(range(plane.shape[0]), range(plane.shape[1])):
            on_plane += hat(b, i) * hat(a, j) * plane[i, j]
        on_line = sum(hat(along, i) * line[i] for i in range(len(line)))
        features.append(on_plane * on_line)
    return np.concatenate(features)


def test_corners_of_the_box_are_the_outermost_cells() -> None:
    planes, lines = volume()
    for corner in itertools.product((0, 1), repeat=3):
        cell = [c * (size - 1) for c, size in zip(corner, SHAPE, strict=True)]
        expected = [
            plane[cell[b], cell[a]] * line[cell[along]]
            for (a, b, along), plane, line in zip(PAIRS, planes, lines, strict=True)
        ]
        point = 2 * torch.tensor(corner, dtype=torch.float64) - 1
        torch.testing.assert_close(plane_line_features(point, planes, lines), torch.cat(expected))


def test_a_feature_fades_out_over_one_cell_beyond_the_box() -> None:
    line = torch.ones(5, 2, dtype=torch.float64)
    cells_beyond = torch.tensor([0.0, 0.25, 0.5, 1.0, 1.5, 100.0], dtype=torch.float64)
    found = line_features(1 + cells_beyond * 2 / 4, line)[:, 0]
    torch.testing.assert_close(found, (1 - cells_beyond).clamp_min(0))


def test_interpolation_is_exact_for_a_bilinear_plane() -> None:
    y, x = torch.meshgrid(torch.linspace(-1, 1, 4), torch.linspace(-1, 1, 7), indexing="ij")
    plane = torch.stack([x, y, x * y], -1)
    points = torch.rand(2, 30, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    px, py = points.unbind(-1)
    torch.testing.assert_close(plane_features(points, plane), torch.stack([px, py, px * py], -1))


def test_equals_the_loop_inside_and_outside() -> None:
    planes, lines = volume()
    points = 3 * torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).double() - 1.5
    points[:8] = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)))
    points[8] = 0
    arrays = [[t.detach().numpy() for t in tables] for tables in (planes, lines)]
    expected = np.stack([slow(point, *arrays) for point in points.numpy()])
    found = plane_line_features(points, planes, lines).detach().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_mixture_is_features_times_basis() -> None:
    planes, lines = volume()
    points = torch.rand(2, 20, 3, dtype=torch.float64) - 0.5
    basis = torch.randn(sum(CHANNELS), 4, dtype=torch.float64)
    expected = plane_line_features(points, planes, lines) @ basis
    torch.testing.assert_close(plane_line_mixture(points, planes, lines, basis), expected)


def test_gradients() -> None:
    planes, lines = volume()
    generator = torch.Generator().manual_seed(3)
    points = (2.4 * torch.rand(12, 3, generator=generator).double() - 1.2).requires_grad_()
    basis = torch.randn(sum(CHANNELS), 3, generator=generator, dtype=torch.float64)

    def call(points: Tensor, basis: Tensor, *grids: Tensor) -> Tensor:
        return plane_line_mixture(points, grids[:3], grids[3:], basis)

    assert torch.autograd.gradcheck(
        call, (points, basis.requires_grad_(), *planes, *lines), fast_mode=True
    )


def test_only_wanted_gradients_are_made() -> None:
    planes, lines = volume()
    points = torch.rand(9, 3, dtype=torch.float64, requires_grad=True)
    for tables in (planes, lines):
        for table in tables:
            table.requires_grad_(False)
    plane_line_features(points, planes, lines).sum().backward()
    assert points.grad is not None
    assert all(table.grad is None for table in (*planes, *lines))


def test_no_points_give_no_features_and_no_gradient() -> None:
    planes, lines = volume()
    found = plane_line_features(torch.zeros(0, 3, dtype=torch.float64), planes, lines)
    assert found.shape == (0, sum(CHANNELS))
    found.sum().backward()
    assert planes[0].grad is not None and not planes[0].grad.any()


def test_more_points_than_one_chunk() -> None:
    planes, lines = volume()
    points = torch.rand(20_000, 3, dtype=torch.float64) * 2 - 1
    found = plane_line_features(points, planes, lines)
    found.sum().backward()
    torch.testing.assert_close(found[-5:], plane_line_features(points[-5:], planes, lines))
    # Constant in every feature, so the gradients of all cells add up to the sum of the lines'.
    pairs = zip(PAIRS, lines, strict=True)
    factors = [line_features(points[:, along], t).sum().item() for (_, _, along), t in pairs]
    assert sum(plane.grad.sum().item() for plane in planes) == pytest.approx(sum(factors))


def test_a_point_that_is_not_a_number_is_not_hidden() -> None:
    planes, lines = volume()
    points = torch.tensor([[0.0, math.nan, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    found = plane_line_features(points, planes, lines)
    assert found[0].isnan().all()
    assert found[1].isfinite().all()


def test_a_point_at_infinity_sees_nothing() -> None:
    planes, lines = volume()
    points = torch.tensor([[1e30, 0.0, 0.0], [0.0, -1e30, 1e30]], dtype=torch.float64)
    assert not plane_line_features(points, planes, lines)[:, : CHANNELS[0]].any()


@pytest.mark.parametrize(
    ("voxels", "shape", "on_planes", "on_lines"),
    [
        (16_777_248, (376, 211, 210), 7_049_824, 22_832),
        (134_217_984, (752, 423, 421), 28_272_944, 45_744),
    ],
)
def test_golden_sizes_of_a_scene(
    voxels: int, shape: tuple[int, int, int], on_planes: int, on_lines: int
) -> None:
    box = torch.tensor([[-1.79035041, -1.00230769, -1.0001], [1.78457007, 1.01, 1.0001]])
    assert grid_shape(box, voxels) == shape
    channels = (64, 16, 16)
    cells = [(shape[a] * shape[b], shape[along]) for a, b, along in PAIRS]
    assert sum(plane * c for (plane, _), c in zip(cells, channels, strict=True)) == on_planes
    assert sum(line * c for (_, line), c in zip(cells, channels, strict=True)) == on_lines
