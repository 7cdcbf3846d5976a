"""Networks around points: encodings as published, shares, sparse gradients, both averages."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sharpfield.fields.neural_points import (
    ColourHead,
    NeuralPoints,
    PointField,
    PointSizes,
    interleaved,
    shares,
    waves,
)

SMALL = PointSizes(channels=4, width=16, feature=8, octaves=(2, 3, 2), axes="world", neighbours=5)


def field(sizes: PointSizes = SMALL, count: int = 60) -> PointField:
    made = torch.Generator().manual_seed(0)
    places = torch.rand(count, 3, generator=made)
    points = NeuralPoints.start(
        places,
        torch.rand(count, 3, generator=made),
        torch.nn.functional.normalize(torch.randn(count, 3, generator=made), dim=-1),
        channels=sizes.channels,
        cell=0.3,
        generator=made,
    )
    return PointField(sizes, points, radius=0.3, seed=0)


def asked(of: PointField, count: int = 7) -> tuple[Tensor, Tensor, Tensor]:
    made = torch.Generator().manual_seed(5)
    places = torch.rand(count, 3, generator=made)
    rows, way = of.neighbours(places)
    return rows, way, torch.randn(count, 3, generator=made)


def test_encodings_have_the_published_order():
    x = torch.tensor([[0.3, -0.7]])
    sin, cos = torch.sin, torch.cos
    each = [f(2**o * v) for v in x[0] for o in range(2) for f in (sin, cos)]
    assert torch.allclose(interleaved(x, 2)[0], torch.stack(each))
    apart = [f(2**o * v) for f in (sin, cos) for v in x[0] for o in range(2)]
    assert torch.allclose(waves(x, 2)[0], torch.stack(apart))
    assert interleaved(torch.zeros(1, 32), 3).shape[-1] == 192
    assert interleaved(torch.zeros(1, 6), 5).shape[-1] == 60
    assert waves(torch.zeros(1, 3), 4).shape[-1] == 24


def test_shares_fall_with_distance_and_sum_to_one():
    way = torch.tensor([[[1.0, 0, 0], [0, 2.0, 0], [0, 0, 4.0]]])
    there = torch.tensor([[True, True, False]])
    assert torch.allclose(shares(way, there), torch.tensor([[2 / 3, 1 / 3, 0]]))
    assert not shares(way, torch.zeros(1, 3, dtype=torch.bool)).any()


@pytest.mark.parametrize("average", ["late", "early"])
def test_absent_neighbours_change_nothing(average: str):
    one = field(replace(SMALL, average=average))
    rows, way, direction = asked(one)
    density, hidden = one.density(rows, way, direction)
    rows = torch.nn.functional.pad(rows, (0, 2), value=-1)
    way = torch.nn.functional.pad(way, (0, 0, 0, 2))
    more = one.density(rows, way, direction)
    assert torch.allclose(more[0], density, atol=1e-6)
    assert torch.allclose(more[1], hidden, atol=1e-5)


@pytest.mark.parametrize("average", ["late", "early"])
def test_points_without_confidence_are_not_there(average: str):
    one = field(replace(SMALL, average=average))
    with torch.no_grad():
        one.points.confidence.fill_(-3)  # counts as nearly nothing, and may come back
    rows, way, direction = asked(one)
    density, _ = one.density(rows, way, direction)
    assert float(density.max()) < 1e-3
    density.sum().backward()
    assert one.points.confidence.grad is not None
    assert float(one.points.confidence.grad.to_dense().abs().max()) > 0


def test_only_neighbours_get_gradients():
    one = field()
    rows, way, direction = asked(one)
    density, hidden = one.density(rows, way, direction)
    (density.sum() + one.feature(hidden, direction).sum()).backward()
    for parameter in one.points.parameters():
        assert parameter.grad is not None and parameter.grad.is_sparse
        moved = set(parameter.grad.coalesce().indices()[0].tolist())
        assert moved <= set(rows[rows >= 0].tolist()) | {0}


def test_both_averages_agree_on_a_single_neighbour():
    late, early = field(), field(replace(SMALL, average="early"))
    rows, way, direction = asked(late)
    one = late.density(rows[:, :1], way[:, :1], direction)
    other = early.density(rows[:, :1], way[:, :1], direction)
    assert torch.allclose(one[0], other[0], atol=1e-5)
    assert torch.allclose(one[1], other[1], atol=1e-5)


def test_colours_begin_where_they_are_told():
    head = ColourHead(6, 3, seed=0)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    start = torch.tensor([[0.2, 0.5, 0.9]])
    assert torch.allclose(head(torch.zeros(1, 6), start), start, atol=2e-3)
    assert torch.allclose(head(torch.zeros(1, 6)), torch.full((1, 3), 0.5))


def test_cells_are_made_anew_when_points_change():
    one = field()
    before = one.points.cells()
    assert one.points.cells() is before
    one.points.replace({name: rows[:10] for name, rows in one.points.points().items()})
    assert len(one.points.cells().order) == 10
    with torch.no_grad():
        one.points.positions.add_(1)
    assert float(one.points.cells().places.min()) >= 1
