import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.simulation.cameras.motions import Composed, Motion, motion
from sharpfield.simulation.cameras.rigs import StillCamera, ring_pose
from sharpfield.simulation.moving_capture import depth_and_flow
from sharpfield.simulation.scenes.moving import MOVING_SCENES, moving_scene
from sharpfield.simulation.scenes.static import scene
from sharpfield.simulation.static_capture import Rig, view

CAMERA = Camera(64, 64, 89.0, 89.0, 32.0, 32.0)
RING = StillCamera(ring_pose(-90))
CASES = {
    **{name: (moving_scene(name), RING) for name in MOVING_SCENES},
    "carried": (moving_scene("spinner"), Composed(StillCamera(ring_pose(-70)), motion("glide", 1))),
    "sway": (scene("mobile"), motion("glide", 1)),
}


def seen_along(place, path, xy, t_us):
    """Light at positions of the image that need not be pixel centres; depth beside it."""
    pose = path.poses(np.array([t_us]))[0]
    across = CAMERA.direction(torch.from_numpy(xy).double()).numpy()
    across = np.ascontiguousarray(across / across[:, 2:]) @ pose[:, :3].T
    return place.light(pose[None, :, 3], across, 1e-6 * t_us, footprint_rad=1 / CAMERA.fx_px)


@pytest.mark.parametrize("name", CASES)
def test_what_is_followed_looks_the_same_a_moment_later(name):
    """Against rendering: light is carried along the flow, except where edges and shadows pass."""
    place, path = CASES[name]
    t_us, later_us = 310_000, 322_000
    depth, flow = depth_and_flow(place, CAMERA, path, t_us)
    xy = CAMERA.grid().double().numpy().reshape(-1, 2)
    rgb, _ = seen_along(place, path, xy, t_us)
    shift = 1e-6 * (later_us - t_us) * flow.reshape(-1, 2).astype(float)
    moves = np.isfinite(depth.reshape(-1)) & (np.abs(shift).max(1) > 0.1)
    assert moves.sum() > 40 and np.abs(shift).max() > 0.25
    followed, _ = seen_along(place, path, xy + shift, later_us)
    stayed, _ = seen_along(place, path, xy, later_us)
    error = np.abs(followed - rgb).mean(1)[moves]
    naive = np.abs(stayed - rgb).mean(1)[moves]
    assert error.mean() < 0.3 * naive.mean()


def test_depth_is_that_of_the_image():
    place, path = CASES["arm"]
    depth, _ = depth_and_flow(place, CAMERA, path, 250_000)
    _, drawn = view(place, CAMERA, path.pose, 0.25)
    empty = drawn > 1e8
    np.testing.assert_array_equal(np.isinf(depth), empty)
    np.testing.assert_allclose(depth[~empty], drawn[~empty], rtol=1e-6)


def test_what_stands_still_has_no_flow():
    _, flow = depth_and_flow(moving_scene("arm"), CAMERA, RING, 250_000)
    assert (np.abs(flow).max(-1) < 1e-6).mean() > 0.6


def test_nothing_flows_as_the_camera_turns():
    """Behind everything, flow is that of a turning camera alone: focal length times rate."""
    path = Motion(np.array([1.0]), np.array([[0, 0, 0, 0, 0.01, 0]]), np.zeros((1, 6)))
    camera = Rig((32, 32)).camera()
    _, flow = depth_and_flow(scene("tiles"), camera, path, 0)
    rate = 0.01 * 2 * np.pi
    np.testing.assert_allclose(flow[16, 16, 0], -camera.fx_px * rate, rtol=2e-3)
