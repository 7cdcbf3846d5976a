import dataclasses

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry import se3
from sharpfield.geometry.normalise import (
    PATH_SAMPLES,
    change_of,
    moved,
    normalised,
    reference_poses,
)
from sharpfield.geometry.space import Similarity, average_pose
from sharpfield.geometry.trajectory import (
    BSpline,
    LearnedExposureMotion,
    LearnedKnots,
    Moved,
    Stamped,
    Still,
    Tracks,
    count_tracks,
)
from tests.geometry.toy import points, poses

CAMERA = Camera(40, 32, 30.0, 30.0, 20.0, 16.0)
CLOCK = Clock(0, 1_000_000)
OPEN = np.array([0, 300_000, 800_000], np.int64)
STAMPS = np.linspace(0, 1_000_000, 11).astype(np.int64)


def capture(*, frames: bool = True, **change: object) -> Capture:
    """Three frames and no events on a winding path around (5, 5, 5)."""
    path = poses(11, turn=0.4).numpy()
    path[:, :, 3] += 5
    images = np.zeros((3, 32, 40, 3), np.uint8)
    given: dict = {
        "camera": CAMERA,
        "trajectory": Stamped(STAMPS, path, CLOCK),
        "clock": CLOCK,
        "near": 2.0,
        "far": 30.0,
        "frames": Frames(
            images, Exposure(OPEN, OPEN + 100_000), np.zeros(3, np.int64), ("a", "b", "c")
        ),
        "events": EventStream(
            *np.zeros((2, 0), np.int16), np.zeros(0, np.int64), np.zeros(0, np.int8), 40, 32
        ),
        "points": points(6).numpy(),
    }
    made = Capture(**{**given, **change})
    return made if frames else made.without(frames=True)


def test_the_nearest_thing_is_four_thirds_away_and_the_average_camera_at_the_origin():
    found, change = normalised(capture())
    assert found.near == pytest.approx(4 / 3)
    assert found.far == pytest.approx(30 / 1.5)
    np.testing.assert_allclose(average_pose(reference_poses(found)), np.eye(3, 4), atol=1e-6)
    assert change.scale == pytest.approx(1 / 1.5)


def test_every_pixel_still_sees_the_same():
    before = capture()
    after, change = normalised(before)
    time = torch.linspace(0, 1, 20, dtype=torch.float64)
    track = torch.zeros(20, dtype=torch.int64)
    inside = points(20) * 0.2 + torch.tensor([0, 0, 3.0])
    world = se3.act(before.trajectory.pose(time, track), inside)
    there = torch.from_numpy(change.points(world.numpy()))
    seen = se3.act(se3.inverse(after.trajectory.pose(time, track)), there)
    torch.testing.assert_close(CAMERA.project(seen), CAMERA.project(inside))
    torch.testing.assert_close(seen[:, 2], inside[:, 2] * change.scale)


def test_points_move_along():
    before = capture()
    after, change = normalised(before)
    np.testing.assert_allclose(after.points, change.points(before.points))
    assert normalised(capture(points=None))[0].points is None


def test_moving_there_and_back():
    before = capture()
    turn = poses(1)[0, :, :3].numpy()
    there = Similarity(2.0, turn, np.array([1.0, 2, 3]))
    back = Similarity(0.5, turn.T, -0.5 * turn.T @ there.translation)
    after = moved(moved(before, there), back)
    every = np.arange(3)
    torch.testing.assert_close(after.frame_pose(every), before.frame_pose(every), rtol=0, atol=1e-5)
    assert (after.near, after.far) == (before.near, before.far)


def test_frames_stand_for_a_capture():
    made = capture()
    wanted = made.frame_pose(np.arange(3)).double().numpy()
    np.testing.assert_array_equal(reference_poses(made), wanted)


def test_or_its_trajectory_does_where_the_source_says_so():
    made = capture(known=Known(reference_poses="trajectory"))
    np.testing.assert_array_equal(reference_poses(made), made.trajectory.poses)
    np.testing.assert_array_equal(reference_poses(capture(frames=False)), made.trajectory.poses)


def test_a_smooth_path_is_looked_at_along_its_way():
    path = BSpline(poses(6, turn=0.3).float(), 0, 1_000_000, CLOCK)
    made = dataclasses.replace(capture(frames=False), trajectory=path)
    found = reference_poses(made)
    assert found.shape == (PATH_SAMPLES, 3, 4)
    ends = path.pose(torch.tensor([0.0, 1.0]), torch.zeros(2, dtype=torch.int64)).detach()
    np.testing.assert_allclose(found[[0, -1]], ends, atol=1e-6)


def test_cameras_that_stand_still_need_no_frames():
    standing = poses(4, turn=0.4).numpy()
    rig = capture(frames=False, trajectory=Still(standing))
    np.testing.assert_allclose(reference_poses(rig), standing, atol=1e-6)


def test_depth_shrinks_with_the_world_and_flow_stays():
    before = capture()
    depth = np.full((3, 32, 40), 6.0, np.float32)
    depth[0, 0, 0] = np.inf
    flow = np.ones((3, 32, 40, 2), np.float32)
    known = dataclasses.replace(before.frames, depth=depth, flow=flow)
    after, change = normalised(dataclasses.replace(before, frames=known))
    np.testing.assert_allclose(after.frames.depth, depth * change.scale)
    np.testing.assert_array_equal(after.frames.flow, flow)


def test_tracks_are_counted():
    path, still = capture().trajectory, Still(poses(4, turn=0.4).numpy())
    both = Tracks([path, path], still.poses)
    change = Similarity(2.0, np.eye(3), np.zeros(3))
    counts = [count_tracks(one) for one in (path, still, both, Moved(both, change))]
    assert counts == [1, 4, 6, 6]


@pytest.mark.parametrize(
    "learned",
    [
        lambda path: path,
        lambda path: LearnedKnots(path, knots=4),
        lambda path: LearnedExposureMotion(path, torch.zeros(1), torch.ones(1), knots=4),
    ],
    ids=["known", "corrected", "shaken"],
)
def test_the_change_of_world_is_known_also_under_what_is_learned(learned):
    there, change = normalised(capture())
    there = dataclasses.replace(there, trajectory=learned(there.trajectory))
    assert change_of(there) is change


def test_a_capture_as_read_went_through_no_change():
    some = points(7).numpy()
    np.testing.assert_array_equal(change_of(capture()).points(some), some)
