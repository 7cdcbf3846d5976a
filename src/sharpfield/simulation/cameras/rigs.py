"""Camera rigs: a ring of static cameras, one hand-held camera, or a walk through the room.

The ring is that of EvDNeRF's simulated data: cameras at a distance of 4 and an elevation of 30
degrees look at the origin, in a world whose z axis points up. Held-out cameras are half a step
between the others.

Source: Bhattacharya et al., *EvDNeRF* (WACV 2024), its poses as published.

The walk goes once around the table in 20 s, looking around, with pauses. The position on that loop
is the integral of a speed that is drawn for segments of half a second, from standstill to fast.
Hand tremor is added, weaker at lower speed. All of it is smooth, and depends on a seed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.errors import OptionError
from sharpfield.core.seed import numpy_generator
from sharpfield.geometry import se3
from sharpfield.simulation.cameras.motions import CameraPath, Composed, motion
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
    level = np.cos(elevation)
    outwards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
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
        [Composed(StillCamera(ring_pose(FIRST_DEG)), motion(name, seed))],
        [StillCamera(ring_pose(FIRST_DEG + angle)) for angle in aside],
    )


LOOP_S = 20.0
"""Once around the table, on average."""
STRETCH_S = 0.5
"""Time from one drawn speed to the next."""
TICK_US = 1000
"""Time step of the table of positions along the loop."""
CALM = 0.12
"""Speed in pauses, as a fraction of the mean speed."""
PAUSES = 0.2
"""Fraction of segments that are pauses."""


@dataclass(frozen=True)
class RoomWalk:
    """A camera path through the room, see `walk`."""

    phase: Float64[np.ndarray, "m"]
    """Position along the loop, in turns around the table, every `TICK_US`."""
    pace: Float64[np.ndarray, "m"]
    """Speed at the same times, as a fraction of the mean."""
    bend: Float64[np.ndarray, "6"]
    """Phases of the slow variations of position and viewing direction."""
    tremor_hz: Float64[np.ndarray, "k"]
    tremor: Float64[np.ndarray, "k 6"]
    """Metres for x, y, z; rad for the turns about them."""
    tremor_phase: Float64[np.ndarray, "k 6"]

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """World-from-camera, OpenCV axes."""
        at = t_us / TICK_US
        ticks = np.arange(len(self.phase))
        turns = 2 * np.pi * np.interp(at, ticks, self.phase)
        pace = np.interp(at, ticks, self.pace)
        angle = 2e-6 * np.pi * t_us[:, None] * self.tremor_hz
        tremor = (self.tremor * np.sin(angle[..., None] + self.tremor_phase)).sum(1)  # [n, 6]
        tremor = tremor * (0.15 + 0.85 * np.minimum(pace, 1.5))[:, None]
        position = self._position(turns) + tremor[:, :3]
        yaw, pitch, roll = self._angles(turns, position)
        turn = [pitch + tremor[:, 3], yaw + tremor[:, 4], roll + tremor[:, 5]]
        rotation = [se3.rotation_exp(torch.from_numpy(_about(k, turn[k]))) for k in (1, 0, 2)]
        rotation = (rotation[0] @ rotation[1] @ rotation[2]).numpy()
        return np.concatenate([rotation, position[:, :, None]], -1)

    def _position(self, turns: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Around the table, with varying distance and height."""
        reach = 1 + 0.08 * np.sin(3 * turns + self.bend[0])
        height = 0.12 * np.sin(2 * turns + self.bend[1]) - 0.05
        return np.stack([1.35 * reach * np.cos(turns), height, 1.0 * reach * np.sin(turns)], -1)

    def _angles(
        self, turns: Float64[np.ndarray, "n"], position: Float64[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
        """Yaw towards the opposite side of the room, and around that; pitch; roll."""
        across = np.unwrap(np.arctan2(-position[:, 0], -position[:, 2]))
        aside = 0.55 * np.sin(4 * turns + self.bend[2]) + 0.2 * np.sin(9 * turns + self.bend[3])
        pitch = -0.17 + 0.16 * np.sin(5 * turns + self.bend[4])
        return across + aside, pitch, 0.04 * np.sin(3 * turns + self.bend[5])


def walk(duration_us: int, seed: int) -> RoomWalk:
    """A walk of a given duration, from a seed; a longer one begins like a shorter one."""
    draw = numpy_generator(seed, 0, "walk")
    bend = draw.uniform(0, 2 * np.pi, 6)
    start = draw.uniform()
    hertz = draw.uniform([2.5, 4.5, 7.0], [4.0, 6.5, 9.0])
    size = np.array([0.006, 0.006, 0.003, 0.006, 0.006, 0.005]) * (4.0 / hertz[:, None])
    tremor = size * draw.uniform(0.6, 1.4, (3, 6))
    tremor_phase = draw.uniform(0, 2 * np.pi, (3, 6))
    stretches = int(np.ceil(1e-6 * duration_us / STRETCH_S)) + 2
    drawn = draw.uniform(size=(stretches, 2))
    speed = np.where(drawn[:, 0] < PAUSES, CALM, 0.45 + 1.5 * drawn[:, 1])
    speed /= PAUSES * CALM + (1 - PAUSES) * 1.2
    ticks = np.arange(duration_us // TICK_US + 2)
    pace = _smoothly(1e-6 * TICK_US * ticks / STRETCH_S, speed)
    step = 1e-6 * TICK_US / LOOP_S * pace
    phase = start + np.concatenate([[0.0], np.cumsum(0.5 * (step[1:] + step[:-1]))])
    return RoomWalk(phase, pace, bend, hertz, tremor, tremor_phase)


def _smoothly(
    at: Float64[np.ndarray, "m"], values: Float64[np.ndarray, "s"]
) -> Float64[np.ndarray, "m"]:
    """Smooth (smoothstep) interpolation of values at 0, 1, 2, ..."""
    left = np.minimum(at.astype(np.int64), len(values) - 2)
    fraction = at - left
    ease = fraction * fraction * (3 - 2 * fraction)
    return values[left] * (1 - ease) + values[left + 1] * ease


def _about(axis: int, angle: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
    vector = np.zeros((len(angle), 3))
    vector[:, axis] = angle
    return vector
