from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.seed import generator
from sharpfield.initialisation.start_points import starting_points
from tests.recipes.planes import depth_at, images


def chance(step: int = 0) -> torch.Generator:
    return generator(0, step, "start")


@pytest.fixture(scope="module")
def held():
    return images()


@pytest.fixture(scope="module")
def started(held):
    return starting_points(held, 2000, chance())


def test_most_start_near_a_wall(started):
    points = started.points
    assert points.shape == started.colours.shape == (2000, 3) and points.dtype == np.float32
    assert (np.abs(points[:, 2] - depth_at(points)) < 0.3).mean() > 0.85


def test_guessing_alone_is_worse(held, started):
    blank = replace(held, light=np.full_like(held.light, 0.5))
    points = starting_points(blank, 2000, chance()).points
    assert (np.abs(points[:, 2] - depth_at(points)) < 0.3).mean() < 0.5
    assert (points[:, 2] > 1.8).all() and (points[:, 2] < 9).all()  # near 2 and far 8


def test_guessed_depths_are_even_in_their_inverse(held):
    blank = replace(held, light=held.light[:1] * 0, poses=np.eye(3, 4)[None])
    inverse = 1 / starting_points(blank, 4000, chance()).points[:, 2]
    counts, _ = np.histogram(inverse, bins=5, range=(1 / 8, 1 / 2))
    assert counts.sum() == 4000 and counts.min() > 720 and counts.max() < 880


def test_points_have_the_colour_of_a_image_that_shows_them(held, started):
    least = np.full(2000, np.inf)
    for view in range(len(held)):
        xy, _ = held.project(started.points, view)
        inside = held.inside(xy)
        off = np.abs(held.light_at(xy[inside], view) - started.colours[inside]).max(-1)
        least[inside] = np.minimum(least[inside], off)
    assert (least < 1e-3).mean() > 0.9


def test_sizes_fill_a_image(held, started):
    """A square of the size's width at each point covers the image once."""
    half = starting_points(held, 2000, chance(), size=0.35)
    np.testing.assert_allclose(half.sizes, started.sizes / 2, rtol=1e-6)
    covered = []
    for view in range(len(held)):
        xy, depth = held.project(started.points, view)
        inside = held.inside(xy)
        wide = started.sizes[inside] / 0.7 * held.camera.fx_px / depth[inside]
        covered.append((wide**2).sum() / (held.camera.width * held.camera.height))
    assert np.mean(covered) == pytest.approx(1, abs=0.2)


def test_a_known_cloud_is_used(held):
    known = np.array([[-0.2 * i, 0.1 * j, 3.0] for i in range(1, 5) for j in range(-3, 4)])
    hidden = np.array([[0.0, 0.0, -4.0], [90.0, 0.0, 3.0]])
    started = starting_points(held, 300, chance(), known=np.concatenate([known, hidden]))
    np.testing.assert_allclose(started.points[:28], known, atol=1e-6)
    blind = np.abs(started.points[28:, 2] - 3) > 0.5
    assert blind.mean() < 0.1
    for view in range(2, 3):
        xy, _ = held.project(known, view)
        assert np.abs(held.light_at(xy, view) - started.colours[:28]).mean() < 0.05


def test_a_cloud_larger_than_the_budget_is_thinned(held):
    known = np.stack([np.linspace(-0.5, 0, 50), np.zeros(50), np.full(50, 3.0)], -1)
    points = starting_points(held, 20, chance(), known=known).points
    assert len(np.unique(points, axis=0)) == 20 and (points[:, 2] == 3).all()


def test_a_known_cloud_of_nothing_means_guessing(held):
    points = starting_points(held, 300, chance(), known=np.zeros((0, 3))).points
    assert (np.abs(points[:, 2] - depth_at(points)) < 0.3).mean() < 0.5


def test_it_depends_on_its_generator_alone(held, started):
    again, other = (starting_points(held, 2000, chance(step)) for step in (0, 1))
    np.testing.assert_array_equal(again.points, started.points)
    assert not np.array_equal(other.points, started.points)
