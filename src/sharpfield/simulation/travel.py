"""How far things move over the image while the shutter is open: the true blur of a frame.

*Travel* is the length of the way over the image, in px, of the point that a pixel sees in the
middle of an exposure, from its opening to its closing; the blur of a frame is the mean over its
pixels.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.exposure import Exposure
from sharpfield.simulation.motion import CameraPath

WAYPOINTS = 9
"""Instants of an exposure at which the points are looked at."""
LEAST_DEPTH = 0.05
"""Points nearer than this, or behind the camera, are left out."""
ROUNDS = 6
"""Corrections of an exposure; travel grows almost evenly with it, so three are enough."""


def travel(
    camera: Camera, path: CameraPath, depth: Float32[np.ndarray, "h w"], window_us: tuple[int, int]
) -> Float64[np.ndarray, "q"]:
    """Lengths of the ways, in px of this camera, of the points that its pixels see.

    Args:
        camera: The lens and sensor; one of few pixels is enough for a mean.
        path: Where the camera is.
        depth: In the middle of the window, along the camera's axis.
        window_us: When the shutter opens and closes.

    Returns:
        One length for each pixel whose point stays before the camera.
    """
    opens, closes = window_us
    times = np.rint(np.linspace(opens, closes, WAYPOINTS)).astype(np.int64)
    rays = camera.direction(camera.grid().double())
    along = torch.from_numpy(depth.astype(np.float64))[..., None]
    inside = (rays / rays[..., 2:] * along).reshape(-1, 3).numpy()
    poses = path.poses(np.append(times, opens + (closes - opens) // 2))
    points = inside @ poses[-1, :, :3].T + poses[-1, :, 3]
    seen = (points - poses[:-1, None, :, 3]) @ poses[:-1, :, :3]  # [t, q, 3]
    there = (seen[..., 2] > LEAST_DEPTH).all(0)
    ways = camera.project(torch.from_numpy(seen[:, there])).numpy()
    return np.linalg.norm(np.diff(ways, axis=0), axis=-1).sum(0)


def exposure_for(
    travels: Callable[[int], Float64[np.ndarray, "n"]],
    *,
    blurry: float,
    blur_px: float,
    most_us: int,
) -> int:
    """How long to expose, in us, so that a share of the frames is blurred by `blur_px` or more.

    Args:
        travels: Mean travel of each frame for an exposure of so many us.
        blurry: Share of frames to blur, 0...1.
        blur_px: From which travel on a frame is blurry.
        most_us: Longest exposure there is time for.
    """
    exposure_us = most_us
    for _ in range(ROUNDS):
        each = np.sort(travels(exposure_us))
        wanted = round(blurry * len(each))
        # With none to be blurred, the fastest stays just below.
        edge = each[len(each) - max(wanted, 1)] * (1.02 if wanted == 0 else 1.0)
        exposure_us = int(min(exposure_us * blur_px / max(edge, 1e-9) + 1, most_us))
    return exposure_us


def instants(exposure: Exposure, frame: int, *, pictures: int) -> Int64[np.ndarray, "k"]:
    """Times at which to draw one exposure: both ends, the middle, and evenly between."""
    opens, closes = exposure.window(frame)
    even = np.rint(np.linspace(opens, closes, pictures)).astype(np.int64)
    return np.unique(np.append(even, exposure.middle_us[frame]))
