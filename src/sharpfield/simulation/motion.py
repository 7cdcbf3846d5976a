"""Camera paths: six seeded sums of sines, three for where the camera is, three for its tilt.

The camera looks along +z, moves mostly sideways so that near things pass before far ones, and never
rests, so that every exposure blurs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.capture import Clock
from sharpfield.core.errors import OptionError
from sharpfield.core.seed import numpy_generator
from sharpfield.geometry import Stamped, se3

STAMP_US = 5000
"""Time between the poses that a capture keeps; a cubic through them is off by less than 1e-4."""


@runtime_checkable
class CameraPath(Protocol):
    """Where a camera is at any time."""

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
        place = (self.amplitude * np.sin(turn[..., None] + self.phase)).sum(1)  # [n, 6]
        rotation = se3.rotation_exp(torch.from_numpy(place[:, 3:])).numpy()
        return np.concatenate([rotation, place[:, :3, None]], -1)

    def faster(self, factor: float) -> "Motion":
        """The same path, run through `factor` times as fast."""
        return replace(self, frequency_hz=factor * self.frequency_hz)


def motion(name: str, seed: int) -> Motion:
    """A path by its name, one of `MOTIONS`.

    Raises:
        OptionError: There is no such path.
    """
    if name not in MOTIONS:
        raise OptionError("unknown motion", got=name, do=f"use one of {', '.join(MOTIONS)}")
    return MOTIONS[name](seed)


def stamped(path: CameraPath, clock: Clock) -> Stamped:
    """The poses of a path over a capture, `STAMP_US` apart, as a trajectory."""
    count = -(-clock.span_us // STAMP_US)
    times = clock.origin_us + np.arange(count + 1) * STAMP_US
    times[-1] = clock.origin_us + clock.span_us
    return Stamped(times, path.poses(times), clock)


def _glide(seed: int) -> Motion:
    """An uneven loop of 0.8 s, as of an arm that swings a camera."""
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
    """The same loop, smaller, held by an unsteady hand."""
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
