import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.errors import OptionError
from sharpfield.core.frames import Exposure, Frames
from sharpfield.evaluation.paths import camera_path
from sharpfield.geometry.trajectory import Still, check_poses
from tests.evaluation.fake import CAMERA, capture

SECOND = 1_000_000


def photos(poses):
    """Photos at these poses, all learned from."""
    count = len(poses)
    taken = np.arange(count) * SECOND
    images = np.zeros((count, 32, 40, 3), np.uint8)
    every = np.arange(count)
    return Capture(
        camera=CAMERA,
        trajectory=Still(poses),
        clock=Clock(0, max(count - 1, 1) * SECOND),
        near=1.0,
        far=4.0,
        frames=Frames(images, Exposure(taken, taken), every, tuple(map(str, every))),
        split=Split(every, np.zeros(0, np.int64)),
    )


def facing_forward(count=20, spread=(0.4, 0.2, 0.1)):
    poses = np.tile(np.eye(3, 4), (count, 1, 1))
    poses[:, :, 3] = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * spread
    return poses


def around_the_origin(count=12, radius=4.0, height=1.5):
    """Cameras on a circle about the vertical that look at the origin."""
    poses = []
    for angle in np.linspace(0, 2 * math.pi, count, endpoint=False):
        centre = np.array([radius * math.cos(angle), -height, radius * math.sin(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0, 1, 0], forward)
        right /= np.linalg.norm(right)
        poses.append(np.stack([right, np.cross(forward, right), forward, centre], -1))
    return np.stack(poses)


@pytest.mark.parametrize("path", ["spiral", "train", "exposure:2"])
@pytest.mark.parametrize("images", [1, 2, 17])
def test_every_path_gives_poses_and_times(path, images):
    made = camera_path(capture(), path, images=images)
    assert len(made) == images == len(made.poses)
    check_poses(made.poses.astype(float))
    assert made.time.min() >= 0 and made.time.max() <= 1


def test_the_spiral_stays_among_the_cameras_and_looks_at_one_point():
    poses = facing_forward()
    made = camera_path(photos(poses), "spiral", images=40).poses.astype(float)
    centre = made[:, :, 3] - poses[:, :, 3].mean(0)
    reach = np.percentile(np.abs(poses[:, :, 3] - poses[:, :, 3].mean(0)), 90, axis=0)
    np.testing.assert_allclose(np.abs(centre).max(0), reach, rtol=0.02)
    depth = 1 / (0.25 / 0.9 + 0.75 / 20)
    target = poses[:, :, 3].mean(0) + [0, 0, depth]
    towards = target - made[:, :, 3]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    np.testing.assert_allclose(made[:, :, 2], towards, atol=1e-5)
    assert (made[:, 1, 1] > 0.9).all()  # down stays down
    # Twice around.
    turned = np.unwrap(np.arctan2(centre[:, 1] / reach[1], centre[:, 0] / reach[0]))
    assert turned[-1] - turned[0] == pytest.approx(4 * math.pi * 39 / 40)


def test_cameras_all_around_give_a_circle():
    made = camera_path(photos(around_the_origin()), "spiral", images=30).poses.astype(float)
    centre, forward = made[:, :, 3], made[:, :, 2]
    np.testing.assert_allclose(np.hypot(centre[:, 0], centre[:, 2]), 4.0, rtol=1e-5)
    np.testing.assert_allclose(centre[:, 1], -1.5, rtol=1e-5)
    np.testing.assert_allclose(
        forward, -centre / np.linalg.norm(centre, axis=-1)[:, None], atol=1e-6
    )
    assert (made[:, 1, 1] > 0).all()
    turned = np.unwrap(np.arctan2(centre[:, 2], centre[:, 0]))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2 * math.pi * 29 / 30)


def test_the_recording_is_followed_evenly_in_time():
    made = camera_path(capture(), "train", images=5)
    np.testing.assert_allclose(made.time, [0, 0.25, 0.5, 0.75, 1])
    expected = capture().trajectory.pose(torch.from_numpy(made.time), torch.zeros(5).long())
    np.testing.assert_array_equal(made.poses, expected)


def test_photos_are_passed_one_after_another():
    poses = facing_forward(5)
    made = camera_path(photos(poses), "train", images=9)
    np.testing.assert_allclose(made.poses[::2], poses, atol=1e-6)
    halfway = (poses[:-1, :, 3] + poses[1:, :, 3]) / 2
    np.testing.assert_allclose(made.poses[1::2, :, 3], halfway, atol=1e-6)


def test_held_out_photos_are_not_passed():
    poses = facing_forward(5)
    scene = replace(photos(poses), split=Split(np.array([0, 2, 4]), np.array([1, 3])))
    made = camera_path(scene, "train", images=3)
    np.testing.assert_allclose(made.poses, poses[[0, 2, 4]], atol=1e-6)


def test_an_exposure_runs_from_open_to_close():
    scene = capture()
    made = camera_path(scene, "exposure:2", images=3)
    open_us, close_us = scene.frames.exposure.open_us[2], scene.frames.exposure.close_us[2]
    np.testing.assert_allclose(made.time[[0, 2]], [open_us / SECOND, close_us / SECOND])
    np.testing.assert_allclose(made.poses[1], scene.frame_pose(np.array([2]))[0], atol=1e-6)


def test_without_frames_the_trajectory_is_followed():
    for path in ("spiral", "train"):
        assert len(camera_path(capture().without(frames=True), path, images=4)) == 4


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("orbit", "unknown camera path\n  got    orbit\n  do     use spiral, train, or exposure:N"),
        ("exposure:", "unknown camera path"),
        ("exposure:99", "no such frame\n  got    99\n  do     use a number from 0 to 5"),
        ("exposure:0", "this frame was taken in one instant, so nothing moves"),
    ],
)
def test_paths_that_do_not_exist(path, message):
    with pytest.raises(OptionError, match=message):
        camera_path(capture(), path)
