"""Neighbours and near places: exact against a tree and a slow loop, for few and many points."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sharpfield.core.errors import OptionError
from sharpfield.ops._dispatch import using
from sharpfield.ops.knn import BRICK, first_near, neighbours, sort_into_cells, window

RADIUS = 0.09


def cloud(count: int, seed: int = 0) -> Tensor:
    """A wavy sheet."""
    made = torch.Generator().manual_seed(seed)
    xy = torch.rand(count, 2, generator=made)
    z = 0.1 * torch.sin(9 * xy[:, :1]) + 0.01 * torch.randn(count, 1, generator=made)
    return torch.cat([xy, z], -1)


def asked(points: Tensor, count: int) -> Tensor:
    made = torch.Generator().manual_seed(9)
    row = torch.randint(len(points), (count,), generator=made)
    return points[row] + 0.05 * torch.randn(count, 3, generator=made)


@pytest.mark.parametrize("choice", ["reference", "fast"])
@pytest.mark.parametrize(("edge", "reach"), [(RADIUS, 1), (RADIUS / 2, 2), (2 * RADIUS, 1)])
def test_neighbours_are_those_of_a_tree(choice: str, edge: float, reach: int):
    points = cloud(700)
    queries = asked(points, 200)
    cells = sort_into_cells(points, edge, reach=reach)
    with using(choice):
        rows, way = neighbours(queries, points, cells, 8, RADIUS)
    away, expected = cKDTree(points.numpy()).query(queries.numpy(), 8, distance_upper_bound=RADIUS)
    assert np.array_equal(rows.numpy(), np.where(expected == len(points), -1, expected))
    there = rows >= 0
    assert torch.allclose(way.norm(dim=-1)[there], torch.from_numpy(away).float()[there], atol=1e-6)
    assert not way[~there].any()


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_a_small_window_hides_what_is_outside(choice: str):
    points = torch.tensor([[0.05, 0.05, 0.05], [0.25, 0.05, 0.05]])
    cells = sort_into_cells(points, 0.1, reach=0)
    with using(choice):
        rows, _ = neighbours(points[:1] + 0.001, points, cells, 2, 1.0)
    assert rows.tolist() == [[0, -1]]


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_nothing_is_found_far_away_and_no_queries_are_fine(choice: str):
    points = cloud(50)
    cells = sort_into_cells(points, RADIUS)
    with using(choice):
        rows, _ = neighbours(torch.full((3, 3), 50.0), points, cells, 4, RADIUS)
        assert (rows == -1).all()
        rows, _ = neighbours(torch.full((3, 3), -50.0), points, cells, 4, RADIUS)
        assert (rows == -1).all()
        rows, way = neighbours(torch.zeros(0, 3), points, cells, 4, RADIUS)
    assert rows.shape == (0, 4)
    assert way.shape == (0, 4, 3)


def test_every_point_is_listed_once():
    points = cloud(400)
    cells = sort_into_cells(points, 0.03)
    assert torch.equal(cells.order.sort().values, torch.arange(400))
    assert torch.equal(cells.places, points[cells.order])
    assert int(cells.start[-1]) == 400
    assert len(cells.start) == len(cells.near) + 1
    assert len(cells.near) % BRICK == 0
    held = cells.start.diff() > 0
    assert cells.near[held].all()


def test_one_point_is_enough():
    one = torch.tensor([[3.0, -2.0, 5.0]])
    cells = sort_into_cells(one, 0.1)
    assert int(cells.near.sum()) == 27
    rows, _ = neighbours(one, one, cells, 3, 0.1)
    assert rows.tolist() == [[0, -1, -1]]


def test_the_window_begins_with_the_own_cell():
    steps = window(1)
    assert steps[0] == (0, 0, 0)
    assert len(set(steps)) == 27


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_rays_stop_where_a_slow_loop_stops(choice: str):
    points, edge, most = cloud(120), 0.05, 6
    cells = sort_into_cells(points, edge)
    made = torch.Generator().manual_seed(4)
    origin = torch.rand(30, 3, generator=made) - torch.tensor([0.0, 0.0, 0.6])
    direction = torch.tensor([0.0, 0.0, 1.0]) + 0.3 * torch.randn(30, 3, generator=made)
    place = (1.5 * torch.rand(30, 64, generator=made)).sort(-1).values
    with using(choice):
        which, where = first_near(origin, direction, place, cells, most)
    low = np.array(cells.origin)
    held = np.floor((points.numpy() - low) / edge)
    for ray in range(30):
        expected = []
        for s, t in enumerate(place[ray]):
            at = (origin[ray] + t * direction[ray]).numpy()
            cell = np.floor((at - low) / edge)
            if (np.abs(held - cell).max(-1) <= 1).any():
                expected.append(s)
        expected = (expected[:most] + [-1] * most)[:most]
        assert which[ray].tolist() == expected
        for s, at in zip(expected, where[ray], strict=True):
            wanted = origin[ray] + place[ray, s] * direction[ray] if s >= 0 else torch.zeros(3)
            assert torch.allclose(at, wanted)


def test_far_off_points_are_refused_in_words():
    points = torch.tensor([[0.0, 0.0, 0.0], [5e4, 5e4, 5e4]])
    with pytest.raises(OptionError, match="points are spread too far for cells so small"):
        sort_into_cells(points, 0.01)
