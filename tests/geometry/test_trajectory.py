import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from sharpfield.core.capture import Clock
from sharpfield.core.errors import CaptureError
from sharpfield.geometry import se3, spline
from sharpfield.geometry.space import Similarity
from sharpfield.geometry.trajectory import (
    BSpline,
    LearnedKnots,
    Moved,
    Stamped,
    Still,
    Tracks,
    check_poses,
)
from tests.geometry.toy import poses

CLOCK = Clock(5_000_000, 2_000_000)
STAMPS = 5_000_000 + np.array([0, 100_000, 450_000, 500_000, 1_200_000, 2_000_000])


def path(count: int = 6, translation: str = "cubic", stream: str = "poses") -> Stamped:
    return Stamped(STAMPS[:count], poses(count, stream=stream).numpy(), CLOCK, translation)


def unit(*, count: int = 101, low: float = 0.0, high: float = 1.0) -> Tensor:
    return torch.linspace(low, high, count, dtype=torch.float64)


def first(time: Tensor) -> Tensor:
    """Track 0 at each time."""
    return torch.zeros_like(time, dtype=torch.int64)


@pytest.mark.parametrize("translation", ["cubic", "linear"])
@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_a_path_passes_its_stamps(count: int, translation: str):
    made = path(count, translation)
    time = torch.from_numpy(CLOCK.unit(STAMPS[:count]))
    found = made.pose(time, first(time))
    torch.testing.assert_close(found, torch.from_numpy(made.poses), rtol=0, atol=1e-12)
    assert np.array_equal(made.times_us, STAMPS[:count])


def test_it_is_scipys_slerp_and_not_a_knot_spline():
    made, time = path(), unit()
    found = made.pose(time, first(time)).numpy()
    stamps = CLOCK.unit(STAMPS)
    centres = CubicSpline(stamps, made.poses[:, :, 3], bc_type="not-a-knot")
    np.testing.assert_allclose(found[:, :, 3], centres(time), atol=1e-10)
    turns = Slerp(stamps, Rotation.from_matrix(made.poses[:, :, :3]))
    np.testing.assert_allclose(found[:, :, :3], turns(time.numpy()).as_matrix(), atol=1e-10)


def test_linear_translation():
    made, time = path(translation="linear"), unit()
    found = made.pose(time, first(time))[:, :, 3].numpy()
    for axis in range(3):
        wanted = np.interp(time, CLOCK.unit(STAMPS), made.poses[:, axis, 3])
        np.testing.assert_allclose(found[:, axis], wanted, atol=1e-12)


def test_before_and_after_a_path_the_camera_stands():
    made = path(4)  # ends at a quarter of the capture
    time = torch.tensor([-0.5, 0.25, 0.9], dtype=torch.float64)
    found = made.pose(time, first(time))
    wanted = torch.from_numpy(made.poses[[0, 3, 3]])
    torch.testing.assert_close(found, wanted)


def test_what_is_known():
    assert path(4).known_us(0) == (5_000_000, 5_500_000)
    assert Still(poses(2).numpy()).known_us(1) is None
    assert BSpline(poses(4), 3, 9, CLOCK).known_us(0) == (3, 9)


def test_poses_of_rays_are_single_precision_and_any_shape():
    made = path()
    time = torch.rand(2, 3, dtype=torch.float32)
    found = made.pose(time, first(time))
    assert found.dtype == torch.float32 and found.shape == (2, 3, 3, 4)
    assert made.pose(time[:0], first(time[:0])).shape == (0, 3, 3, 4)


def test_still_cameras_stand_on_their_tracks():
    fixed = poses(3)
    track = torch.tensor([2, 0, 0, 1])
    found = Still(fixed.numpy()).pose(torch.rand(4), track)
    torch.testing.assert_close(found, fixed.float()[track])


def test_tracks_are_told_apart():
    movers = [path(stream="a"), path(stream="b")]
    fixed = poses(3, stream="fixed").numpy()
    made = Tracks(movers, fixed)
    time = unit(count=40)
    track = torch.arange(40) * 3 % 5
    found = made.pose(time, track)
    for i in range(40):
        t, number = time[i], int(track[i])
        if number < 2:
            wanted = movers[number].pose(t, torch.tensor(0))
        else:
            wanted = torch.from_numpy(fixed[number - 2]).float().double()
        torch.testing.assert_close(found[i], wanted)
    assert made.known_us(1) == movers[1].known_us(0) and made.known_us(2) is None


@pytest.mark.parametrize("movers", [0, 1])
def test_tracks_of_one_kind_only(movers: int):
    made = Tracks([path() for _ in range(movers)], poses(4, stream="fixed").numpy())
    time = unit(count=4)
    for track in (torch.arange(4), torch.full((4,), 1), torch.zeros(4, dtype=torch.int64)):
        wanted = [made.pose(t[None], n[None])[0] for t, n in zip(time, track, strict=True)]
        torch.testing.assert_close(made.pose(time, track), torch.stack(wanted))
    assert made.pose(time[:0], track[:0]).shape == (0, 3, 4)


def test_a_bspline_of_equal_knots_stands_still():
    pose = poses(1)
    made, time = BSpline(pose.expand(6, 3, 4), 5_000_000, 7_000_000, CLOCK), unit()
    torch.testing.assert_close(made.pose(time, first(time)), pose.expand(101, 3, 4))


def test_a_bspline_is_its_segments():
    knots = poses(6, turn=0.5)
    made = BSpline(
        knots, 5_500_000, 7_000_000, CLOCK
    )  # three segments, each a quarter of the clock
    for segment in range(3):
        for part in (0.0, 0.3, 0.9):
            time = torch.tensor(0.25 * (1 + segment + part), dtype=torch.float64)
            found = made.pose(time, torch.tensor(0))
            wanted = spline.bspline(knots[segment : segment + 4], torch.tensor(part).double())
            torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)
    early, late = torch.tensor([0.0, 0.25]).double(), torch.tensor([1.0, 1.7]).double()
    for pair in (early, late):
        both = made.pose(pair, first(pair))
        torch.testing.assert_close(both[0], both[1])


def test_learned_knots_start_as_their_base():
    base, time = path(), unit()
    made = LearnedKnots(base, knots=6)
    torch.testing.assert_close(made.pose(time, first(time)), base.pose(time, first(time)))
    assert made.known_us(0) == base.known_us(0)


def test_learned_knots_correct_in_camera_axes_and_per_track():
    base = Still(poses(2).numpy())
    made = LearnedKnots(base, knots=5, tracks=2).double()
    twist = torch.tensor([0.1, -0.2, 0.3, 1.0, 2.0, 3.0], dtype=torch.float64)
    made.twist.data[1] = twist  # all knots of the second track
    time, track = unit(count=8), torch.arange(8) % 2
    found, before = made.pose(time, track), base.pose(time, track)
    torch.testing.assert_close(found[::2], before[::2])
    wanted = se3.compose(before[1::2], se3.exp(twist).expand(4, 3, 4))
    torch.testing.assert_close(found[1::2], wanted)


def test_a_moved_path():
    base, time = path(), unit()
    turn = poses(1, stream="turn")[0, :, :3].numpy()
    change = Similarity(2.5, turn, np.array([1.0, -2, 3]))
    found = Moved(base, change).pose(time, first(time))
    wanted = change.poses(base.pose(time, first(time)).numpy())
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert Moved(base, change).known_us(0) == base.known_us(0)


def test_gradients_in_time():
    time = torch.tensor([0.01, 0.3, 0.77], dtype=torch.float64, requires_grad=True)
    for made in (path(), path(translation="linear"), Tracks([path()], poses(1).numpy())):
        assert torch.autograd.gradcheck(lambda t, p=made: p.pose(t, first(t)), (time,))


def test_gradients_of_knots():
    time = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    for made in (
        BSpline(poses(5, turn=0.5), 5_000_000, 7_000_000, CLOCK).double(),
        LearnedKnots(path(), knots=5).double(),
    ):
        made.pose(time, first(time)).sum().backward()
        grad = made.twist.grad
        assert grad is not None and grad.isfinite().all()
        assert (grad.abs().amax(-1) > 0).all(), "every knot is near one of the times"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Stamped(STAMPS[:0], poses(1).numpy()[:0], CLOCK),
            "CaptureError: there must be one time for each pose, and at least one\n"
            "  got    0 times, 0 poses",
        ),
        (
            lambda: Stamped(np.array([5, 9, 9]), poses(3).numpy(), CLOCK),
            "CaptureError: times of poses must ascend\n"
            "  where  poses 1 and 2\n"
            "  got    9 us, then 9 us\n"
            "  do     sort them, and drop repeated stamps",
        ),
        (
            lambda: BSpline(torch.eye(3, 4).expand(3, 3, 4), 0, 1, CLOCK),
            "CaptureError: a cubic B-spline needs at least 4 knots\n  got    3",
        ),
        (
            lambda: LearnedKnots(path(), knots=2),
            "CaptureError: a cubic B-spline needs at least 4 knots\n  got    2",
        ),
        (
            lambda: check_poses(np.stack([np.eye(3, 4), np.full((3, 4), np.nan)]), "poses.npy"),
            "CaptureError: a pose holds NaN or infinity\n  where  poses.npy, pose 1",
        ),
        (
            lambda: Still(np.stack([np.eye(3, 4), np.eye(3, 4)[[1, 0, 2]]])),
            "CaptureError: a rotation is not orthonormal and right-handed\n"
            "  where  poses, pose 1\n"
            "  got    |R^T R - 1| up to 0, det R = -1\n"
            "  do     check the axis convention, and that rows and columns were not exchanged",
        ),
        (
            lambda: check_poses(2 * np.eye(3, 4)[None]),
            "CaptureError: a rotation is not orthonormal and right-handed\n"
            "  where  poses, pose 0\n"
            "  got    |R^T R - 1| up to 3, det R = 8\n"
            "  do     check the axis convention, and that rows and columns were not exchanged",
        ),
    ],
)
def test_impossible_paths_are_refused(make, message: str):
    with pytest.raises(CaptureError) as refused:
        make()
    assert str(refused.value) == message
