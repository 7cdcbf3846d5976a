"""A capture: everything recorded of one scene, on one clock and in one coordinate system."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64, Shaped
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.frames import DepthMaps, Frames
from sharpfield.core.protocols import Trajectory

POSE_TOLERANCE_US = 2
"""Rounding of times in published files: poses may end this much before an exposure does."""

USUAL_THRESHOLD = 0.2
"""Contrast threshold assumed for an event camera whose thresholds are unknown, natural log."""

Note = Shaped[np.ndarray, "..."] | float | str
"""A remark about a capture, for people to read: no computation depends on it."""

Certainty = Literal["known", "estimated", "unknown"]
"""How well something is known: measured or stated, guessed from other data, or not at all."""


@dataclass(frozen=True)
class Thresholds:
    """Contrast thresholds of an event camera in natural log, both positive; medians over pixels."""

    negative: float
    positive: float
    certainty: Certainty = "known"


@dataclass(frozen=True)
class Known:
    """What is known about a capture besides the measurements themselves."""

    poses: Certainty = "known"
    """Unknown: the trajectory is a placeholder, a static camera."""
    motion: Certainty = "known"
    """Motion of the camera during exposures. Unknown: each frame has a single pose and a made-up
    time, and may be blurred or sharp."""
    intrinsics: Certainty = "known"
    """Unknown: the focal length is a placeholder."""
    bounds: Certainty = "known"
    """Depth bounds `near` and `far`. Unknown: both are placeholders."""
    thresholds: Thresholds | None = None
    """Contrast thresholds of the event camera; None where they are unknown."""
    log_floor: float | None = None
    """Linear light that the event camera adds before it takes the logarithm."""
    refractory_us: float | None = None
    """How long an event pixel is blind after an event, in us."""
    background: Literal["", "white"] = ""
    """White: transparent pixels were composited on white."""
    reference_poses: Literal["frames", "trajectory"] = "frames"
    """Poses over which the authors of a data set normalise the scene."""

    def __post_init__(self) -> None:
        numbers = {"log_floor": self.log_floor, "refractory_us": self.refractory_us}
        if self.thresholds is not None:
            numbers |= {"threshold_negative": self.thresholds.negative}
            numbers |= {"threshold_positive": self.thresholds.positive}
        for name, value in numbers.items():
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise CaptureError(f"`{name}` must be a finite number, not negative", got=value)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of what is unknown among poses, motion, intrinsics and bounds."""
        names = ("poses", "motion", "intrinsics", "bounds")
        return tuple(name for name in names if getattr(self, name) == "unknown")


@dataclass(frozen=True)
class Clock:
    """Converts times in us to the unit times 0...1 that rays carry.

    float32 represents whole us only up to 16.8 s, but a fraction of a capture of one minute is
    accurate to 3.6 us, which suffices for poses. Differences of event times are computed in int64.
    """

    origin_us: int
    span_us: int

    def unit(self, t_us: Int64[np.ndarray, "*n"] | int) -> Float[np.ndarray, "*n"]:
        """Times as a fraction of the capture, float64; an array also for a single time."""
        return np.asarray((np.asarray(t_us, np.int64) - self.origin_us) / self.span_us)

    def us(self, unit: Float[np.ndarray, "*n"] | float) -> Int64[np.ndarray, "*n"]:
        """Times in us, rounded; an array also for a single time."""
        since = np.rint(np.asarray(unit) * self.span_us).astype(np.int64)
        return np.asarray(since + self.origin_us)


@dataclass(frozen=True)
class Split:
    """Training frames and held-out test frames, by index."""

    train: Int64[np.ndarray, "a"]
    test: Int64[np.ndarray, "b"]

    def __repr__(self) -> str:
        return f"Split({len(self.train)} to learn from, {len(self.test)} held out)"


@dataclass(frozen=True)
class Capture:
    """Frames, events, or both, with the camera and its trajectory."""

    camera: Camera
    trajectory: Trajectory
    clock: Clock
    near: float
    """Nearest depth of the scene along a camera's axis, in world units."""
    far: float
    frames: Frames | None = None
    events: EventStream | None = None
    test_events: EventStream | None = None
    """Events of cameras on held-out tracks, for testing only."""
    split: Split = Split(np.zeros(0, np.int64), np.zeros(0, np.int64))
    points: Float[np.ndarray, "m 3"] | None = None
    """Sparse scene points of a reconstruction, if there is one."""
    depth: DepthMaps | None = None
    """Maps of a depth camera, one for each frame."""
    name: str = "capture"
    source: str = ""
    """The layout that it was read from."""
    known: Known = Known()
    """What is known, estimated or unknown of poses, lens, bounds and event camera."""
    notes: dict[str, Note] = field(default_factory=dict[str, Note])
    """Remarks for people, such as which frames were left out; no computation depends on them."""

    def __post_init__(self) -> None:
        if self.frames is None and self.events is None:
            raise CaptureError("a capture needs frames or events, and has neither", where=self.name)
        if not 0 < self.near < self.far:
            raise CaptureError(
                "depth bounds must satisfy 0 < near < far",
                where=self.name,
                got=f"near {self.near}, far {self.far}",
                do="check the last two columns of the poses, or `near` and `far`",
            )
        if self.frames is not None:
            self._expect_fitting_frames(self.frames)
            self._expect_covered_exposures(self.frames)
        if self.depth is not None and len(self.depth) != len(self.frames or ()):
            raise CaptureError(
                "there must be one depth map for each frame",
                where=self.name,
                got=f"{len(self.depth)} maps, {len(self.frames or ())} frames",
                do="give a map for each frame, 0 where unknown",
            )

    def __repr__(self) -> str:
        parts = [self.frames, self.events, self.depth]
        held = ", ".join(repr(part) for part in parts if part is not None)
        return f"Capture({self.name!r}, {self.clock.span_us * 1e-6:.3g} s: {held})"

    @cached_property
    def frame_time(self) -> Float[Tensor, "n 2"]:
        """Opening and closing time of each frame as the unit times that rays carry."""
        frames = self.needed_frames
        times = [frames.exposure.open_us, frames.exposure.close_us]
        return torch.as_tensor(np.stack([self.clock.unit(t) for t in times], -1)).float()

    @property
    def needed_frames(self) -> Frames:
        """The frames.

        Raises:
            CaptureError: There are none.
        """
        if self.frames is None:
            raise CaptureError("this needs frames, and the capture has none", where=self.name)
        return self.frames

    @property
    def needed_events(self) -> EventStream:
        """The events.

        Raises:
            CaptureError: There are none.
        """
        if self.events is None:
            raise CaptureError("this needs events, and the capture has none", where=self.name)
        return self.events

    @property
    def needed_depth(self) -> DepthMaps:
        """The depth maps.

        Raises:
            CaptureError: There are none.
        """
        if self.depth is None:
            raise CaptureError(
                "this needs measured depth, and the capture has none",
                where=self.name,
                do="use a capture of a depth camera, or one of `sharpfield simulate --scene room`",
            )
        return self.depth

    def frame_pose(self, frames: Int64[np.ndarray, "m"]) -> Float[Tensor, "m 3 4"]:
        """World-from-camera poses at the middle of the exposures of some frames.

        With a rolling shutter, at the middle of the exposure of the middle row.
        """
        held = self.needed_frames
        exposure = held.exposure
        middle = exposure.middle_us[frames] + round(exposure.readout_us(held.height) / 2)
        time = torch.as_tensor(self.clock.unit(middle)).float()
        return self.trajectory.pose(time, torch.as_tensor(held.track[frames]))

    def without(self, *, frames: bool = False, events: bool = False) -> "Capture":
        """The same capture without frames (and depth), or without events."""
        return replace(
            self,
            frames=None if frames else self.frames,
            depth=None if frames else self.depth,
            events=None if events else self.events,
            test_events=None if events else self.test_events,
        )

    def _expect_fitting_frames(self, frames: Frames) -> None:
        if (frames.width, frames.height) != self.camera.size:
            raise CaptureError(
                "images and camera have different sizes",
                where=self.name,
                got=f"images {frames.width}x{frames.height},"
                f" camera {self.camera.width}x{self.camera.height}",
                do="give the intrinsics for the images' own size",
            )
        used = np.concatenate([self.split.train, self.split.test])
        if len(used) and (used.min() < 0 or used.max() >= len(frames)):
            raise CaptureError(
                "the split names frames that do not exist",
                where=self.name,
                got=f"indices {used.min()} to {used.max()} of {len(frames)} frames",
                do="use indices from 0 to the number of frames - 1",
            )

    def _expect_covered_exposures(self, frames: Frames) -> None:
        for track in np.unique(frames.track):
            known = self.trajectory.known_us(int(track))
            if known is None:
                continue
            member = np.flatnonzero(frames.track == track)
            opens, closes = frames.exposure.open_us[member], frames.exposure.close_us[member]
            closes = closes + int(frames.exposure.readout_us(frames.height))
            wrong = member[
                (opens < known[0] - POSE_TOLERANCE_US) | (closes > known[1] + POSE_TOLERANCE_US)
            ]
            if len(wrong):
                i = int(wrong[0])
                raise CaptureError(
                    f"poses do not cover {len(wrong)} of {len(member)} exposures",
                    where=f"{self.name}, frame {frames.names[i]} (track {track})",
                    got=f"poses from {known[0]} to {known[1]} us, exposure from"
                    f" {frames.exposure.open_us[i]} to {frames.exposure.close_us[i]} us",
                    do=_unit_hint(frames, known)
                    or "give poses for the whole exposure, or leave these frames out",
                )


def _unit_hint(frames: Frames, known: tuple[int, int]) -> str:
    """Advice where two clocks differ by a factor of 1000: nearly always a wrong unit."""
    last_frame, last_pose = int(frames.exposure.close_us.max()), max(abs(known[1]), 1)
    ratio = max(last_frame, 1) / last_pose
    if 300 < ratio < 3000:
        return "exposure times look like ns where us were expected: divide them by 1000"
    if 300 < 1 / ratio < 3000:
        return "pose times look like ns where us were expected: divide them by 1000"
    return ""
