import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, CubicSpline

from sharpfield.geometry import se3, spline
from tests.geometry.toy import poses

TIMES = np.cumsum([0.3, 0.1, 0.7, 0.2, 1.3, 0.05, 0.4, 0.4, 2.0, 0.6])


def values(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3))


def at(coefficients: np.ndarray, times: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The piecewise cubic, evaluated segment by segment."""
    i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(coefficients) - 1)
    s = (t - times[i])[:, None]
    c0, c1, c2, c3 = coefficients[i].transpose(1, 0, 2)
    return c0 + s * (c1 + s * (c2 + s * c3))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 10])
def test_a_cubic_passes_its_points(count: int):
    times, points = TIMES[:count], values(count)
    found = at(spline.cubic_coefficients(times, points), times, times)
    np.testing.assert_allclose(found, points, atol=1e-12)


@pytest.mark.parametrize("count", [4, 10])
def test_a_cubic_goes_through_itself(count: int):
    """Points of one cubic polynomial give that polynomial: nothing is lost at the ends."""
    times = TIMES[:count]
    cubic = np.polynomial.Polynomial([1, -2, 0.5, 0.3])
    found = spline.cubic_coefficients(times, cubic(times)[:, None])
    t = np.linspace(times[0], times[-1], 50)
    np.testing.assert_allclose(at(found, times, t)[:, 0], cubic(t), rtol=1e-9)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 10])
def test_it_is_scipys_not_a_knot_spline(count: int):
    times, points = TIMES[:count], values(count)
    found = spline.cubic_coefficients(times, points)
    wanted = CubicSpline(times, points, bc_type="not-a-knot")
    t = np.linspace(times[0], times[-1], 101)
    np.testing.assert_allclose(at(found, times, t), wanted(t), atol=1e-11)


def test_what_goes_in_is_left_alone():
    times, points = TIMES.copy(), values(10)
    before = points.copy()
    spline.cubic_coefficients(times, points)
    assert np.array_equal(times, TIMES) and np.array_equal(points, before)


def test_weights_sum_to_one_and_mirror():
    u = torch.linspace(0, 1, 33, dtype=torch.float64)
    weights = spline.bspline_weights(u)
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(u))
    assert (weights >= 0).all()
    torch.testing.assert_close(spline.bspline_weights(1 - u), weights.flip(-1))


def test_weights_are_scipys():
    u = np.linspace(0, 0.999, 20)
    basis = BSpline(np.arange(8.0), np.eye(4), 3)  # knots 0...7: the middle segment is 3...4
    found = spline.bspline_weights(torch.from_numpy(u))
    np.testing.assert_allclose(found, basis(3 + u), atol=1e-12)


def test_equal_knots_stand_still():
    pose = poses(1)
    u = torch.linspace(0, 1, 7, dtype=torch.float64)
    torch.testing.assert_close(spline.bspline(pose.expand(7, 4, 3, 4), u), pose.expand(7, 3, 4))


def test_without_rotation_it_is_the_weighted_mean():
    knots = poses(4, turn=0.0)
    u = torch.linspace(0, 1, 7, dtype=torch.float64)
    found = spline.bspline(knots.expand(7, 4, 3, 4), u)
    wanted = spline.bspline_weights(u) @ knots[..., 3]
    torch.testing.assert_close(found[..., 3], wanted)


def test_it_moves_with_the_world():
    change, knots = poses(1, stream="change"), poses(4)
    u = torch.tensor([0.3], dtype=torch.float64)
    moved = spline.bspline(se3.compose(change.expand(4, 3, 4), knots)[None], u)
    torch.testing.assert_close(moved, se3.compose(change, spline.bspline(knots[None], u)))


def test_segments_join_smoothly():
    """Position, velocity and acceleration agree where one segment ends and the next begins."""
    knots = poses(5, turn=0.6)

    def derivatives(segment: torch.Tensor, u: float) -> list[torch.Tensor]:
        def along(x: torch.Tensor) -> torch.Tensor:
            return spline.bspline(segment, x)

        def velocity(x: torch.Tensor) -> torch.Tensor:
            return torch.func.jvp(along, (x,), (torch.ones_like(x),))[1]

        place = torch.tensor(u, dtype=torch.float64)
        bend = torch.func.jvp(velocity, (place,), (torch.ones_like(place),))[1]
        return [along(place), velocity(place), bend]

    for before, after in zip(derivatives(knots[:4], 1.0), derivatives(knots[1:], 0.0), strict=True):
        torch.testing.assert_close(before, after, rtol=0, atol=1e-9)


def test_gradients():
    u = torch.tensor([0.0, 0.4], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(spline.bspline_weights, (u,))
    knots = poses(2, 4, turn=0.5).requires_grad_()
    assert torch.autograd.gradcheck(spline.bspline, (knots, u))
