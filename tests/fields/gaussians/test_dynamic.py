"""Gaussians around moments: where they are, how opaque, and that they keep their rows."""

import math

import pytest
import torch

from sharpfield.fields.gaussians.dynamic import (
    MAX_AGE,
    GaussianUnion,
    MovingGaussians,
    quaternion_of,
    quaternion_product,
)
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry.se3 import rotation_exp, rotation_from_quaternion


def some(count: int = 5, lifespan: float = 0.2) -> MovingGaussians:
    """Gaussians at moments from 0.3 to 0.7 that move, turn and bend."""
    made = torch.Generator().manual_seed(1)
    colours = torch.rand(count, 3, generator=made)
    base = Gaussians.start(torch.rand(count, 3, generator=made), colours, torch.full((count,), 0.1))
    moving = MovingGaussians(base, torch.linspace(0.3, 0.7, count), lifespan=lifespan)
    with torch.no_grad():
        for name in ("velocities", "accelerations", "jerks", "angular_velocities", "quaternions"):
            rows = getattr(moving, name)
            rows.copy_(torch.randn(rows.shape, generator=made))
    return moving


def test_at_its_moment_each_is_as_it_is_stored():
    moving = some()
    for row, moment in enumerate(moving.centre_times.tolist()):
        seen = moving.at(moment)
        at = seen.active.nonzero()[:, 0].tolist().index(row)
        torch.testing.assert_close(seen.means[at], moving.means[row])
        torch.testing.assert_close(seen.quaternions[at], moving.quaternions[row])
        torch.testing.assert_close(seen.opacities[at], moving.opacities[row])


@pytest.mark.parametrize("time", [0.35, 0.5, 0.65])
def test_paths_turns_and_fading_against_a_slow_loop(time: float):
    moving = some()
    seen = moving.at(time)
    assert seen.active.all()
    for row in range(len(moving)):
        since = time - float(moving.centre_times[row])
        path = since * moving.velocities[row] + since**2 / 2 * moving.accelerations[row]
        path = path + since**3 / 6 * moving.jerks[row]
        torch.testing.assert_close(seen.means[row], moving.means[row] + path)
        faded = math.exp(-0.5 * (since / 0.2) ** 4)
        torch.testing.assert_close(seen.opacities[row], moving.opacities[row] * faded)
        turned = rotation_exp(moving.angular_velocities[row] * since) @ rotation_from_quaternion(
            moving.quaternions[row]
        )
        found = rotation_from_quaternion(
            torch.nn.functional.normalize(seen.quaternions[row], dim=0)
        )
        torch.testing.assert_close(found, turned, atol=1e-5, rtol=0)


def test_products_of_quaternions_are_those_of_rotations():
    made = torch.Generator().manual_seed(2)
    first, second = torch.randn(2, 6, 3, generator=made, dtype=torch.float64)
    whole = rotation_from_quaternion(
        quaternion_product(quaternion_of(first), quaternion_of(second))
    )
    torch.testing.assert_close(whole, rotation_exp(first) @ rotation_exp(second))


def test_those_of_other_times_are_not_drawn():
    moving = some(lifespan=0.01)
    seen = moving.at(0.3 + 0.99 * MAX_AGE * 0.01)
    assert seen.active.tolist() == [True, False, False, False, False]
    assert len(seen.means) == len(seen.opacities) == 1
    assert seen.colours(torch.zeros(2, 3)).shape == (2, 1, 3)
    assert moving.at(0.9).means.shape == (0, 3)


def test_for_most_of_its_span_each_stays_as_opaque():
    moving = some()
    opaque = [float(moving.at(0.3 + 0.2 * age).opacities[0]) for age in (0, 0.5, 1, 1.5, 1.85)]
    full = float(moving.opacities[0].detach())
    assert opaque[0] == pytest.approx(full) and opaque[1] > 0.96 * full
    assert 0.6 * full < opaque[2] < 0.61 * full
    assert opaque[3] < 0.09 * full and opaque[4] < 0.003 * full


def test_still_and_moving_ones_are_drawn_together():
    moving = some()
    base = Gaussians.start(torch.zeros(2, 3), torch.zeros(2, 3), torch.full((2,), 0.5), sh_degree=1)
    both = GaussianUnion(base, moving.at(0.5))
    assert both.means.shape == both.scales.shape == (7, 3)
    assert both.quaternions.shape == (7, 4) and both.opacities.shape == (7,)
    torch.testing.assert_close(
        both.colours(torch.ones(1, 3))[:, 2:], moving.colours(torch.ones(1, 3))
    )


def test_gradients_of_everything_that_moves():
    moving = some(3).double()
    names = (
        "means",
        "velocities",
        "accelerations",
        "jerks",
        "angular_velocities",
        "centre_times",
        "log_lifespans",
    )
    rows = [getattr(moving, name).detach().clone().requires_grad_() for name in names]

    def at(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        moving.replace(dict.fromkeys(()))
        for name, value in zip(names, values, strict=True):
            moving._parameters.pop(name, None)
            moving.__dict__[name] = value
        seen = moving.at(0.45)
        return seen.means, seen.quaternions, seen.opacities

    assert torch.autograd.gradcheck(at, rows)


def test_rows_can_be_taken_over():
    moving = some()
    rows = torch.tensor([0, 0, 4])
    moving.replace({name: values[rows] for name, values in moving.points().items()})
    assert len(moving) == 3
    assert {
        "centre_times",
        "log_lifespans",
        "velocities",
        "angular_velocities",
    } <= moving.points().keys()
    torch.testing.assert_close(moving.centre_times, torch.tensor([0.3, 0.3, 0.7]))
