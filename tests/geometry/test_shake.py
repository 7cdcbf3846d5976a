"""Motion inside each exposure, learned where nothing else tells of it."""

import pytest
import torch
from torch import Tensor

from sharpfield.geometry import se3, spline
from sharpfield.geometry.trajectory import LearnedExposureMotion, Still
from tests.geometry.toy import poses, twists

OPENS = torch.tensor([0.0, 0.3, 0.7], dtype=torch.float64)
CLOSES = torch.tensor([0.2, 0.5, 1.0], dtype=torch.float64)
KNOTS = 5


def base() -> Still:
    return Still(poses(3, stream="photos").numpy())


def shaken(start: Tensor | None = None) -> LearnedExposureMotion:
    return LearnedExposureMotion(base(), OPENS, CLOSES, knots=KNOTS, start=start)


def start() -> Tensor:
    return 0.1 * twists(3, KNOTS, stream="start")


def test_without_twists_the_photos_stand_where_they_were_taken():
    time, track = torch.rand(4, 2, dtype=torch.float64), torch.tensor([0, 2]).expand(4, 2)
    torch.testing.assert_close(shaken().pose(time, track), base().pose(time, track))


def test_it_is_the_spline_of_its_own_twists():
    """Slowly, one pose at a time."""
    made, twist = shaken(start()), start()
    for track in range(3):
        for part in (0.0, 0.31, 0.5, 0.77, 0.999):
            place = part * (KNOTS - 3)
            first = int(place)
            weights = spline.bspline_weights(torch.tensor(place - first, dtype=torch.float64))
            moved = sum(weights[i] * twist[track, first + i] for i in range(4))
            time = OPENS[track] + part * (CLOSES[track] - OPENS[track])
            found = made.pose(time, torch.tensor(track))
            wanted = se3.compose(base().pose(time, torch.tensor(track)), se3.exp(moved))
            torch.testing.assert_close(found, wanted)


def test_a_twist_that_is_the_same_at_all_knots_moves_the_whole_exposure_by_it():
    same = twists(3, 1, stream="same").expand(3, KNOTS, 6)
    time = OPENS + torch.tensor([0.1, 0.05, 0.3], dtype=torch.float64)
    track = torch.arange(3)
    found = shaken(same).pose(time, track)
    torch.testing.assert_close(found, se3.compose(base().pose(time, track), se3.exp(same[:, 0])))


def test_outside_its_exposure_the_camera_stands_still():
    made, track = shaken(start()), torch.tensor(1)
    inside = made.pose(torch.stack([OPENS[1], CLOSES[1]]), track.expand(2))
    outside = made.pose(torch.tensor([0.1, 0.9], dtype=torch.float64), track.expand(2))
    torch.testing.assert_close(outside, inside)
    assert (inside[0] - inside[1]).abs().max() > 0.01


def test_it_moves_without_a_jump():
    made = shaken(start())
    time = torch.linspace(float(OPENS[2]), float(CLOSES[2]), 2001, dtype=torch.float64)
    step = made.pose(time, torch.full_like(time, 2, dtype=torch.int64)).diff(dim=0).abs().amax()
    assert 0 < step < 1e-2


@pytest.mark.parametrize("track", [0, 1, 2])
def test_a_photo_learns_its_own_motion_alone(track: int):
    made = shaken()
    time = (OPENS[track] + CLOSES[track])[None] / 2
    made.pose(time, torch.tensor([track])).sum().backward()
    assert made.twist.grad is not None
    touched = made.twist.grad.abs().sum((1, 2)) > 0
    assert touched.tolist() == [track == i for i in range(3)]


def test_gradients_of_the_twists():
    track = torch.tensor([0, 1, 1, 2])
    time = torch.tensor([0.05, 0.31, 0.47, 0.9], dtype=torch.float64)

    def moved(twist: Tensor) -> Tensor:
        made = shaken()
        del made.twist  # a parameter cannot be computed
        made.twist = twist
        return made.pose(time, track)

    assert torch.autograd.gradcheck(moved, start().requires_grad_(), fast_mode=True)


def test_the_first_twists_stay_the_callers():
    given = start()
    made = shaken(given)
    made.twist.data += 1
    assert torch.equal(given, start())


def test_what_is_known_is_what_the_base_knows():
    assert shaken().known_us(1) is None
