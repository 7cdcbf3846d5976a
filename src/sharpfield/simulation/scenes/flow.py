"""Depth and optical flow as truth: where what a pixel sees is, and how fast it moves in the image.

A pixel looks along the ray through its centre. The point it meets is followed with its body for a
moment before and after, and seen by the camera where that is then.
"""

import numpy as np
import torch
from jaxtyping import Float32, Float64

from sharpfield.core.camera import Camera
from sharpfield.simulation.cameras.motions import CameraPath
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.scenes.surfaces import meet

MOMENT_US = 100
"""How long a point is followed to each side."""
FARAWAY = 1e6
"""Depth of what lies behind everything, when the camera turns."""


def depth_and_flow(
    place: Scene, camera: Camera, path: CameraPath, t_us: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w 2"]]:
    """Depth along the camera's axis (infinite where nothing is), and flow in px per second."""
    pose = path.poses(np.array([t_us]))[0]
    across = camera.direction(camera.grid().double()).reshape(-1, 3).numpy()
    across = np.ascontiguousarray(across / across[:, 2:]) @ pose[:, :3].T
    time_s = 1e-6 * t_us
    which, depth = meet(place.at(time_s), pose[None, :, 3], across, time_s, 1 / camera.fx_px)
    points = pose[:, 3] + np.where(which >= 0, depth, FARAWAY)[:, None] * across
    before, after = (
        _seen(camera, path, place.followed(points, which, time_s, 1e-6 * t), t)
        for t in (t_us - MOMENT_US, t_us + MOMENT_US)
    )
    shape = camera.height, camera.width
    flow = (after - before) / (2e-6 * MOMENT_US)
    seen = np.where(which >= 0, depth, np.inf).astype(np.float32)
    return seen.reshape(shape), flow.reshape(*shape, 2).astype(np.float32)


def _seen(
    camera: Camera, path: CameraPath, points: Float64[np.ndarray, "n 3"], t_us: int
) -> Float64[np.ndarray, "n 2"]:
    """Where the camera sees points at a time."""
    pose = path.poses(np.array([t_us]))[0]
    inside = (points - pose[:, 3]) @ pose[:, :3]
    return camera.project(torch.from_numpy(inside)).numpy()
