from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import DepthMaps
from sharpfield.initialisation.fused_points import fuse_points
from tests.streams import HEIGHT, WIDTH

PLANE = 3.0
"""Where a wall stands, z in the world."""


@pytest.fixture
def walled(panning: Capture) -> Capture:
    """The panning capture before a wall, seen by a depth camera of half its size."""
    camera = Camera(WIDTH // 2, HEIGHT // 2, 5.5, 5.5, WIDTH / 4, HEIGHT / 4)
    maps = DepthMaps(np.ones((len(panning.frames), *camera.size[::-1]), np.uint16), camera)
    poses = panning.frame_pose(np.arange(len(panning.frames))).double().numpy()
    along = np.einsum("nij,hwj->nhwi", poses[:, :, :3], maps.rays())[..., 2]
    depth = (PLANE - poses[:, 2, 3, None, None]) / along
    stored = np.rint(depth * 1000).astype(np.uint16)
    stored[:, 0, 0] = 0
    return replace(panning, depth=replace(maps, stored=stored))


def test_points_lie_on_the_wall_and_face_the_camera(walled):
    cloud = fuse_points(walled, stride=1, voxel=1e-4)
    np.testing.assert_allclose(cloud.points[:, 2], PLANE, atol=2e-3)
    known = np.linalg.norm(cloud.normals, axis=1) > 0.5
    assert known.mean() > 0.5
    assert (cloud.normals[known, 2] < -0.98).all()
    assert (cloud.views >= 1).all() and cloud.colours.min() >= 0 and cloud.colours.max() <= 1


def test_points_are_the_pixels_of_a_slow_loop(walled):
    one = replace(walled, split=Split(np.array([4]), np.zeros(0, np.int64)))
    cloud = fuse_points(one, stride=1, voxel=1e-5)
    pose = one.frame_pose(np.array([4]))[0].double().numpy()
    expected = []
    for row in range(HEIGHT // 2):
        for column in range(WIDTH // 2):
            z = one.depth.stored[4, row, column] / 1000
            if z:
                ray = np.array(
                    [(column + 0.5 - WIDTH / 4) / 5.5, (row + 0.5 - HEIGHT / 4) / 5.5, 1]
                )
                expected.append(pose[:, :3] @ (z * ray) + pose[:, 3])
    expected = np.array(expected)
    assert len(cloud) == len(expected)
    nearest = np.linalg.norm(cloud.points[:, None] - expected, axis=-1).min(1)
    assert nearest.max() < 1e-5


def test_large_voxels_count_the_frames_that_saw_them(walled):
    cloud = fuse_points(walled, stride=1, voxel=100.0)
    assert cloud.views.max() == len(walled.split.train)


def test_merging_again_and_again_changes_nothing(walled, monkeypatch):
    whole = fuse_points(walled, stride=1, voxel=0.05)
    monkeypatch.setattr("sharpfield.initialisation.fused_points.MAX_PENDING", 10)
    often = fuse_points(walled, stride=1, voxel=0.05)
    np.testing.assert_array_equal(often.views, whole.views)
    np.testing.assert_allclose(often.points, whole.points, rtol=1e-6)
    np.testing.assert_allclose(often.colours, whole.colours, atol=1e-6)


def test_held_out_depth_is_left_alone_unless_told(walled):
    maps = walled.depth.stored.copy()
    maps[walled.split.test] = 500  # half a metre away: nothing else is
    poisoned = replace(walled, depth=replace(walled.depth, stored=maps))
    far = fuse_points(poisoned, stride=1).points[:, 2]
    leaked = fuse_points(poisoned, frames="all", stride=1).points[:, 2]
    assert far.min() > 2.9 and leaked.min() < 1.0


def test_weights_choose_whose_colours_count(walled):
    weight = np.zeros(len(walled.frames))
    weight[3] = 1.0
    images = np.zeros_like(walled.frames.images)
    images[3] = 255
    painted = replace(walled, frames=replace(walled.frames, images=images))
    cloud = fuse_points(painted, stride=1, voxel=100.0, weight=weight)
    assert cloud.colours[np.argmax(cloud.views)].min() > 0.999
    assert fuse_points(painted, stride=1, voxel=100.0).colours.max() < 0.5


def test_depth_limits(walled):
    with pytest.raises(CaptureError, match="the depth maps hold no points"):
        fuse_points(walled, max_depth=1.0)
    assert len(fuse_points(walled, min_depth=1.0)) > 0


def test_errors_say_what_is_missing(panning, walled):
    with pytest.raises(CaptureError, match="needs measured depth, and the capture has none"):
        fuse_points(panning)
    with pytest.raises(OptionError, match="stride and voxel must be positive"):
        fuse_points(walled, voxel=0.0)
    with pytest.raises(CaptureError, match="too far apart for voxels"):
        fuse_points(walled, voxel=1e-7)
    with pytest.raises(CaptureError, match="one depth map for each frame"):
        replace(walled, depth=replace(walled.depth, stored=walled.depth.stored[:3]))
