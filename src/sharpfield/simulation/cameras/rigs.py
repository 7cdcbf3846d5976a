"""Camera rigs: a ring of static cameras around the scene, or one hand-held camera.

The ring is that of EvDNeRF's simulated data: cameras at a distance of 4 and an elevation of 30
degrees look at the origin, in a world whose z axis points up. Held-out cameras are half a step
between the others.

Source: Bhattacharya et al., *EvDNeRF* (WACV 2024), its poses as published.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.errors import OptionError
from sharpfield.geometry import se3
from sharpfield.simulation.cameras.motions import CameraPath, Motion, motion
from sharpfield.simulation.scenes.building import Real

RADIUS, ELEVATION_DEG = 4.0, 30.0
FIRST_DEG = -90.0
"""Azimuth of the first camera."""
RING_FOCAL = 50 / 36
"""Focal length over the image width: a 50 mm lens on a 36 mm sensor."""


@dataclass(frozen=True)
class StillCamera:
    """A static camera."""

    pose: Float64[np.ndarray, "3 4"]

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """The same at any time."""
        return np.broadcast_to(self.pose, (len(t_us), 3, 4)).copy()


@dataclass(frozen=True)
class CarriedCamera:
    """A camera that moves around a base pose along a path of small movements."""

    base: Float64[np.ndarray, "3 4"]
    path: Motion

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """World-from-camera: the movement in the axes of the base pose."""
        base, moved = torch.from_numpy(self.base), torch.from_numpy(self.path.poses(t_us))
        return se3.compose(base.expand_as(moved), moved).numpy()


@dataclass(frozen=True)
class Views:
    """The cameras of a rig; each is a track of the capture."""

    learned: Sequence[CameraPath]
    held_out: Sequence[CameraPath] = ()
    """Their frames and events are for testing."""


def ring_pose(
    azimuth_deg: Real, *, elevation_deg: Real = ELEVATION_DEG, radius: Real = RADIUS
) -> Float64[np.ndarray, "3 4"]:
    """World-from-camera of a camera that looks at the origin, z up in the image; OpenCV axes."""
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    outwards = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    forward = -outwards
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return np.stack([right, down, forward, radius * outwards], 1)


def ring(views: int, *, held_out: int = 0) -> Views:
    """Cameras evenly spaced on the ring, and held-out ones half a step between them.

    Raises:
        OptionError: There are fewer than one, or more held out than others.
    """
    if views < 1 or not 0 <= held_out <= views:
        raise OptionError(
            "a ring has at least one view, and no more held out than others",
            got=f"{views} views, {held_out} held out",
        )
    step = 360 / views
    between = np.arange(held_out) * views // max(held_out, 1) + 0.5
    return Views(
        [StillCamera(ring_pose(FIRST_DEG - step * k)) for k in range(views)],
        [StillCamera(ring_pose(FIRST_DEG - step * k)) for k in between],
    )


def hand_held(name: str = "glide", *, seed: int = 0, held_out: int = 0) -> Views:
    """One hand-held camera in front of the scene, and held-out static ones on the ring near it.

    Args:
        name: A path, one of `MOTIONS`.
        seed: Of the path.
        held_out: Their number, within 20 degrees to both sides.
    """
    aside = np.linspace(-20, 20, held_out) if held_out > 1 else np.zeros(held_out)
    return Views(
        [CarriedCamera(ring_pose(FIRST_DEG), motion(name, seed))],
        [StillCamera(ring_pose(FIRST_DEG + angle)) for angle in aside],
    )
