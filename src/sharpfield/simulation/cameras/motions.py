"""Camera paths, and the true motion blur of the frames along them.

A path is six seeded sums of sines, three for the position of the camera, three for its rotation.
The camera looks along +z, moves mostly sideways so that there is parallax, and never stops, so that
every exposure is blurred.

*Travel* is the length of the path over the image, in px, of the point at a pixel in the middle of
an exposure, from its opening to its closing; the blur of a frame is the mean over its pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Clock
from sharpfield.core.errors import expect_one_of
from sharpfield.core.frames import Exposure
from sharpfield.core.seed import numpy_generator
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped

STAMP_US = 5000
"""Time between the poses of a capture; the error of a cubic through them is below 1e-4."""


@runtime_checkable
class CameraPath(Protocol):
    """The pose of a camera at any time."""

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """World-from-camera, OpenCV axes."""
        ...


@dataclass(frozen=True)
class Motion:
    """A closed-form camera path; column k is one sine of all six movements."""

    frequency_hz: Float64[np.ndarray, "k"]
    amplitude: Float64[np.ndarray, "k 6"]
    """World units for x, y, z; rad for the turns about them."""
    phase: Float64[np.ndarray, "k 6"]

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """World-from-camera, OpenCV axes."""
        turn = 2e-6 * np.pi * t_us[:, None] * self.frequency_hz  # [n, k]
        state = (self.amplitude * np.sin(turn[..., None] + self.phase)).sum(1)  # [n, 6]
        rotation = se3.rotation_exp(torch.from_numpy(state[:, 3:])).numpy()
        return np.concatenate([rotation, state[:, :3, None]], -1)

    def faster(self, factor: float) -> "Motion":
        """The same path, `factor` times as fast."""
        return replace(self, frequency_hz=factor * self.frequency_hz)


@dataclass(frozen=True)
class Composed:
    """A path within another: small movements about a base pose, or a path in a drifting world."""

    outer: CameraPath
    inner: CameraPath
    """In the axes of the outer one."""

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """World-from-camera, OpenCV axes."""
        outer, inner = (torch.from_numpy(one.poses(t_us)) for one in (self.outer, self.inner))
        return se3.compose(outer, inner).numpy()


def motion(name: str, seed: int) -> Motion:
    """A path by its name, one of `MOTIONS`.

    Raises:
        OptionError: There is no such path.
    """
    expect_one_of("motion", name, MOTIONS)
    return MOTIONS[name](seed)


def stamped(path: CameraPath, clock: Clock) -> Stamped:
    """The poses of a path over a capture, `STAMP_US` apart, as a trajectory."""
    count = -(-clock.span_us // STAMP_US)
    times = clock.origin_us + np.arange(count + 1) * STAMP_US
    times[-1] = clock.origin_us + clock.span_us
    return Stamped(times, path.poses(times), clock)


def _glide(seed: int) -> Motion:
    """An irregular loop of 0.8 s, as of a camera swung by an arm."""
    draw = numpy_generator(seed, 0, "motion")
    size = draw.uniform(0.9, 1.1, 6)
    start, turn = draw.uniform(0, 2 * np.pi), draw.choice([-1, 1])
    loop = np.array([0.40, 0.31, 0.10, 0.012, 0.016, 0.008]) * size
    wobble = np.array([0.05, 0.05, 0.03, 0.003, 0.004, 0.004]) * draw.uniform(0.8, 1.2, 6)
    along = np.array([0, turn * np.pi / 2, 0.7, 1.1, 2.0, 0.3]) + start
    return Motion(
        np.array([1.25, 2.9]),
        np.stack([loop, wobble]),
        np.stack([along, draw.uniform(0, 2 * np.pi, 6)]),
    )


def _shaky(seed: int) -> Motion:
    """The same loop, smaller, with hand tremor."""
    base, draw = _glide(seed), numpy_generator(seed, 0, "shake")
    frequency = draw.uniform([4.0, 6.5, 9.0], [5.5, 8.0, 11.0])
    tremor = np.array([0.02, 0.02, 0.01, 0.009, 0.009, 0.009])
    amplitude = tremor * (4.5 / frequency[:, None]) * draw.uniform(0.7, 1.3, (3, 6))
    return Motion(
        np.concatenate([base.frequency_hz, frequency]),
        np.concatenate([0.7 * base.amplitude, amplitude]),
        np.concatenate([base.phase, draw.uniform(0, 2 * np.pi, (3, 6))]),
    )


MOTIONS: dict[str, Callable[[int], Motion]] = {"glide": _glide, "shaky": _shaky}
"""Paths by name."""


WAYPOINTS = 9
"""Instants of an exposure at which points are projected."""
LEAST_DEPTH = 0.05
"""Points nearer than this, or behind the camera, are left out."""
ROUNDS = 6
"""Iterations of `exposure_for`; travel is almost linear in the exposure, so three are enough."""


def travel(
    camera: Camera, path: CameraPath, depth: Float32[np.ndarray, "h w"], window_us: tuple[int, int]
) -> Float64[np.ndarray, "q"]:
    """Travel of the points at all pixels, in px of this camera.

    Args:
        camera: The lens and sensor; one of few pixels is enough for a mean.
        path: Of the camera.
        depth: In the middle of the window, along the camera's axis.
        window_us: When the shutter opens and closes.

    Returns:
        One length for each pixel whose point stays in front of the camera.
    """
    opens, closes = window_us
    times = np.rint(np.linspace(opens, closes, WAYPOINTS)).astype(np.int64)
    rays = camera.direction(camera.grid().double())
    along = torch.from_numpy(depth.astype(np.float64))[..., None]
    inside = (rays / rays[..., 2:] * along).reshape(-1, 3).numpy()
    poses = path.poses(np.append(times, opens + (closes - opens) // 2))
    points = inside @ poses[-1, :, :3].T + poses[-1, :, 3]
    by_time = (points - poses[:-1, None, :, 3]) @ poses[:-1, :, :3]  # [t, q, 3]
    visible = (by_time[..., 2] > LEAST_DEPTH).all(0)
    tracks = camera.project(torch.from_numpy(by_time[:, visible])).numpy()  # [t, q, 2]
    return np.linalg.norm(np.diff(tracks, axis=0), axis=-1).sum(0)


def exposure_for(
    travels: Callable[[int], Float64[np.ndarray, "n"]],
    *,
    blurry: float,
    blur_px: float,
    most_us: int,
) -> int:
    """Exposure time in us for which a fraction of the frames is blurred by `blur_px` or more.

    Args:
        travels: Mean travel of each frame, given the exposure in us.
        blurry: Fraction of frames to blur, 0...1.
        blur_px: Travel from which a frame counts as blurry.
        most_us: Longest possible exposure.
    """
    exposure_us = most_us
    for _ in range(ROUNDS):
        each = np.sort(travels(exposure_us))
        wanted = round(blurry * len(each))
        # With none to blur, the fastest frame stays just below the limit.
        edge = each[len(each) - max(wanted, 1)] * (1.02 if wanted == 0 else 1.0)
        exposure_us = int(min(exposure_us * blur_px / max(edge, 1e-9) + 1, most_us))
    return exposure_us


def instants(exposure: Exposure, frame: int, *, images: int) -> Int64[np.ndarray, "k"]:
    """Times at which to render one exposure: both ends, the middle, and evenly in between."""
    opens, closes = exposure.window(frame)
    even = np.rint(np.linspace(opens, closes, images)).astype(np.int64)
    return np.unique(np.append(even, exposure.middle_us[frame]))
