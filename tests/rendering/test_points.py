"""Marching through points: opacity in closed form, missed rays, what is asked."""

import pytest
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.rays import Rays
from sharpfield.ops.knn import first_near, neighbours, sort_into_cells
from sharpfield.rendering.points import PointMarch, ShadedSamples

DENSITY = 3.0


class Wall:
    """Points on the plane z = 2; every place near them is as dense."""

    def __init__(self) -> None:
        y, x = torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(-1, 1, 41), indexing="ij")
        self.points = torch.stack([x, y, torch.full_like(x, 2)], -1).reshape(-1, 3)
        self.cells = sort_into_cells(self.points, 0.1)
        self.asked = 0

    def near(self, origin: Tensor, direction: Tensor, place: Tensor, most: int):
        return first_near(origin, direction, place, self.cells, most)

    def neighbours(self, places: Tensor):
        return neighbours(places, self.points, self.cells, 4, 0.1)

    def density(
        self,
        rows: Int64[Tensor, "q k"],
        way: Float[Tensor, "q k 3"],
        direction: Float[Tensor, "q 3"],
        turn: Float[Tensor, "q 3 3"] | None = None,
    ) -> tuple[Tensor, Tensor]:
        self.asked += len(rows)
        return torch.full((len(rows),), DENSITY), way.norm(dim=-1)


def rays(slope: tuple[float, ...] = (0.0, 0.2, 3.0)) -> Rays:
    direction = torch.tensor([[s, 0.0, 1.0] for s in slope])
    direction = torch.nn.functional.normalize(direction, dim=-1)
    count = len(slope)
    return Rays(torch.zeros(count, 3), direction, torch.zeros(count), torch.ones(count))


def red(asked: ShadedSamples) -> Tensor:
    return torch.tensor([1.0, 0.0, 0.0]).expand(len(asked), 3)


def test_opacity_is_that_of_so_many_equal_places():
    wall = Wall()
    march = PointMarch(wall, 0.0, 4.0, steps=200, asked=24, thickness=0.1, background=0.25)
    met = march(rays((0.0,)), red)
    opacity = 1 - torch.exp(torch.tensor(-DENSITY * 0.1 * wall.asked))
    assert met.opacity[0] == pytest.approx(float(opacity), abs=1e-5)
    assert met.colour[0, 0] == pytest.approx(float(opacity + 0.25 * (1 - opacity)), abs=1e-5)
    assert met.colour[0, 1] == pytest.approx(float(0.25 * (1 - opacity)), abs=1e-5)
    assert 1.9 * float(opacity) < float(met.depth[0]) < 2.1 * float(opacity)
    assert met.densest[0] == pytest.approx(1 - float(torch.tensor(-DENSITY * 0.1).exp()), abs=1e-5)
    assert met.where[0, 2] == pytest.approx(2, abs=0.12)


def test_rays_past_all_points_miss_and_show_the_background():
    met = PointMarch(Wall(), 0.0, 8.0, steps=400, thickness=1.0, background=0.5)(rays(), red)
    assert met.hit.tolist() == [True, True, False]
    assert torch.equal(met.colour[2], torch.full((3,), 0.5))
    assert met.opacity[2] == 0


def test_nothing_but_missed_rays_is_fine():
    met = PointMarch(Wall(), 0.0, 8.0)(rays((5.0, -6.0)), red)
    assert not met.hit.any()
    assert met.rows.shape == (0, 4)


def test_with_the_camera_the_ray_parameter_is_depth():
    wall = Wall()
    march = PointMarch(wall, 0.0, 4.0, steps=200, thickness=100.0, background=0.0)
    turn = torch.eye(3).expand(1, 3, 3)
    along, depth = (march(rays((0.4,)), red, turn=t).depth[0] for t in (None, turn))
    assert depth == pytest.approx(float(along) / (1 + 0.4**2) ** 0.5, abs=0.03)


def test_steps_are_uneven_by_the_generator_alone():
    march = PointMarch(Wall(), 0.0, 4.0, steps=200, thickness=1.0)
    one, same = (march(rays(), red, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    other = march(rays(), red, generator=torch.Generator().manual_seed(2))
    assert torch.equal(one.depth, same.depth)
    assert not torch.equal(one.depth, other.depth)
