"""Options and summary of `ingest`, and correction of wrong event axes and polarities.

`sharpfield doctor` detects such errors by comparing events with frames.
"""

from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Chunks, Recording

Stamp = Literal["open", "middle", "close"]
"""Meaning of the single time of a frame."""


@dataclass(frozen=True)
class Optics:
    """Lens calibration."""

    calibration: Path | None = None
    """Calibration file of Kalibr, OpenCV, ROS, DSEC, or RPG's calib.txt. Without one, the focal
    length is a placeholder until it is estimated with the poses."""
    camera: str | None = None
    """Name of the event camera in the calibration, where it has several: cam0."""
    frame_camera: str | None = None
    """Name of the frame camera in the calibration, where it is another one: cam1."""
    rectify: bool = False
    """Undistort: frames by resampling, events by giving them positions between pixels."""
    resize: bool = False
    """Scale frames to the resolution of the event sensor, where both share one lens."""


@dataclass(frozen=True)
class Cleaning:
    """Event filters."""

    hot: float = 10.0
    """Remove hot pixels: those with so many times the events of the pixels around them. 0: none."""
    isolated_ms: float = 0.0
    """Remove events without another event at the 8 neighbouring pixels in the ms before: noise, and
    some signal. 0: none."""


@dataclass(frozen=True)
class Crop:
    """Time range to keep, in ms from the first event."""

    start_ms: float | None = None
    end_ms: float | None = None


@dataclass(frozen=True)
class Timing:
    """When frames were exposed."""

    exposure: str | None = None
    """Exposure time, where the recording does not give it: 8ms, or 0.5 of the frame interval.
    Without it such frames are treated as instants, free of blur."""
    stamp: Stamp = "open"
    """Meaning of the single time of such a frame: shutter opening, middle, or closing."""
    clock: Literal["auto", "same", "triggers", "find"] = "auto"
    """How frame times of a second recording are converted to the clock of the events: `same` if
    both have one clock, `triggers` if the frame camera drives a trigger input of the event camera,
    `find` by correlating what both see. By default triggers if there are any, else find."""
    trigger_channel: int | None = None
    """Trigger channel that the frame camera drives, where there are several."""
    offset_ms: float | None = None
    """Offset to add to the frame times in ms, instead of searching for it."""


@dataclass(frozen=True)
class Scene:
    """Poses, depth bounds, colour."""

    poses: Path | None = None
    """File of camera poses: TUM format, or the trajectory.npz of a capture."""
    near: float | None = None
    """Smallest depth of the scene, in units of the poses."""
    far: float | None = None
    """Largest depth of the scene."""
    encoding: str | None = None
    """Encoding of the pixel values: linear, gamma2.2 or srgb. By default srgb for videos and
    images, linear for raw colour, else gamma2.2."""
    bayer: str | None = None
    """Colour filter array of the sensor, where the recording does not give it: RGGB, GRBG, GBRG,
    BGGR; or `none`."""


@dataclass(frozen=True)
class IngestOptions:
    """All options of `ingest`."""

    optics: Optics = field(default_factory=Optics)
    cleaning: Cleaning = field(default_factory=Cleaning)
    crop: Crop = field(default_factory=Crop)
    timing: Timing = field(default_factory=Timing)
    scene: Scene = field(default_factory=Scene)


StepProgress = Callable[[str, int, int | None], None]
"""Called with the name of a step, how much of it is done, and the total where it is known."""


@dataclass(frozen=True)
class IngestSummary:
    """Result of an ingestion."""

    events: int
    """Number of events in the capture."""
    frames: int
    span_us: tuple[int, int]
    """First and last time of the capture."""
    left_out: dict[str, int]
    """What was left out, by reason."""
    hot_pixels: int
    clock: str
    """How frame times were converted to the clock of the events; "" if they were not."""
    unknown: tuple[str, ...]
    """What is unknown yet: poses, intrinsics, depth bounds."""


def assign_roles(recordings: tuple[Recording, ...]) -> tuple[Recording | None, Recording | None]:
    """The recording that gives the events, and the one that gives the frames.

    Raises:
        OptionError: There are too many, or both hold the same kind of data.
    """
    with_events = [one for one in recordings if one.events is not None]
    with_frames = [one for one in recordings if one.frames is not None]
    if len(recordings) not in (1, 2) or not (with_events or with_frames):
        raise OptionError("give one recording, or two", got=len(recordings))
    if len(with_events) > 1 or (len(recordings) > 1 and not with_events):
        raise OptionError(
            "of two recordings one must give the events and the other the frames",
            got=" and ".join(f"{one.path} ({one.layout})" for one in recordings),
        )
    events = with_events[0] if with_events else None
    others = [one for one in with_frames if one is not events]
    frames = others[0] if others else with_frames[0] if with_frames else None
    return events, frames


@dataclass(frozen=True)
class AxisFixes:
    """Errors of the event axes and polarities in a file."""

    swap_xy: bool = False
    """Exchange columns and rows."""
    flip_x: bool = False
    """Mirror columns, after any exchange."""
    flip_y: bool = False
    """Mirror rows."""
    flip_polarity: bool = False
    """Invert polarities."""

    @property
    def words(self) -> list[str]:
        """The errors in words."""
        every = ("x and y swapped", "x mirrored", "y mirrored", "polarity flipped")
        return [word for word, wrong in zip(every, astuple(self), strict=True) if wrong]

    @property
    def flags(self) -> str:
        """The options of `sharpfield ingest` that correct them."""
        return " ".join(f"--{n.replace('_', '-')}" for n, wrong in asdict(self).items() if wrong)


def fixed_axes(recording: Recording, fixes: AxisFixes) -> Recording:
    """A recording with corrected events; frames are unchanged.

    Where axes are exchanged, width and height of the sensor are exchanged as well.
    """
    if not fixes.words or recording.events is None:
        return recording
    opened, size = recording.events, recording.size
    if size is not None and fixes.swap_xy:
        size = size[::-1]

    def events() -> Chunks:
        return (_fixed(chunk, fixes) for chunk in opened())

    layout = f"{recording.layout} ({', '.join(fixes.words)})"
    return replace(recording, events=events, size=size, layout=layout)


def _fixed(events: EventStream, fixes: AxisFixes) -> EventStream:
    x, y, width, height = events.x, events.y, events.width, events.height
    if fixes.swap_xy:
        x, y, width, height = y, x, height, width
    if fixes.flip_x:
        x = (width - 1 - x).astype(x.dtype)
    if fixes.flip_y:
        y = (height - 1 - y).astype(y.dtype)
    p = (-events.p).astype(np.int8) if fixes.flip_polarity else events.p
    return replace(events, x=x, y=y, p=p, width=width, height=height)
