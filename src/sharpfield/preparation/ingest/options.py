"""What can be chosen when a recording is ingested; the command line has an option for each.

Mistakes of the writer of a recording, undone: axes exchanged or mirrored, signs flipped.

`sharpfield doctor` finds them by comparing events with frames.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.preparation.ingest.clock import Stamp
from sharpfield.preparation.ingest.lens import Optics
from sharpfield.recordings.recording import Chunks, Recording


@dataclass(frozen=True)
class Cleaning:
    """Which events to leave out."""

    hot: float = 10.0
    """Silence pixels that report so many times as often as the pixels around them; 0 keeps all."""
    lonely_ms: float = 0.0
    """Leave out events that none of the eight pixels around joined within so long before; this
    takes noise, and some of the signal. 0 keeps all."""


@dataclass(frozen=True)
class Crop:
    """Which part to keep, in ms from the first event."""

    start_ms: float | None = None
    end_ms: float | None = None


@dataclass(frozen=True)
class Timing:
    """When frames were exposed."""

    exposure: str | None = None
    """How long the shutter was open, where the recording does not say: 8ms, or 0.5 of the time
    from one frame to the next. Without it such frames are taken for instants, free of blur."""
    stamp: Stamp = "open"
    """What the single time of such a frame is: its shutter's opening, the middle, its closing."""
    clock: Literal["auto", "same", "triggers", "find"] = "auto"
    """How the times of frames of a second recording come to the clock of the events: `same` if
    both were on one clock, `triggers` if the frame camera drives a trigger of the other, `find` by
    what both see. By default triggers if there are any, else find."""
    trigger_channel: int | None = None
    """The one that the frame camera drives, where there are several."""
    offset_ms: float | None = None
    """What to add to the times of the frames; nothing is searched for then."""


@dataclass(frozen=True)
class Scene:
    """What is known besides."""

    poses: Path | None = None
    """Where the camera was: TUM's format, or the trajectory.npz of a capture."""
    near: float | None = None
    """Nearest depth of the scene, in units of the poses."""
    far: float | None = None
    """Farthest."""
    encoding: str | None = None
    """How stored values of frames relate to light: linear, gamma2.2 or srgb. By default srgb for
    videos and images, linear for raw colour, else gamma2.2."""
    bayer: str | None = None
    """Colour filter tile of the sensor, where the recording does not say: RGGB, GRBG, GBRG, BGGR;
    or `none`."""


@dataclass(frozen=True)
class IngestOptions:
    """Everything that can be chosen."""

    optics: Optics = field(default_factory=Optics)
    cleaning: Cleaning = field(default_factory=Cleaning)
    crop: Crop = field(default_factory=Crop)
    timing: Timing = field(default_factory=Timing)
    scene: Scene = field(default_factory=Scene)


def roles(
    recordings: tuple[Recording, ...],
) -> tuple[Recording | None, Recording | None]:
    """Which recording gives the events, and which the frames.

    Raises:
        OptionError: There are too many, or both give the same.
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
    """What is wrong with the events of a recording."""

    swap_xy: bool = False
    """Columns and rows are exchanged."""
    flip_x: bool = False
    """Columns count from the right, after any exchange."""
    flip_y: bool = False
    """Rows count from the bottom."""
    flip_polarity: bool = False
    """Brighter is said to be darker."""

    def __str__(self) -> str:
        """In words; nothing if nothing is wrong."""
        words = {
            "x and y exchanged": self.swap_xy,
            "x mirrored": self.flip_x,
            "y mirrored": self.flip_y,
            "polarity flipped": self.flip_polarity,
        }
        return ", ".join(word for word, wrong in words.items() if wrong)


def fixed_axes(recording: Recording, mistakes: AxisFixes) -> Recording:
    """The same recording without the mistakes; its frames are as they were.

    The size of a recording whose axes are exchanged is taken to be exchanged as well.
    """
    if not str(mistakes) or recording.events is None:
        return recording
    opened, size = recording.events, recording.size
    if size is not None and mistakes.swap_xy:
        size = size[::-1]

    def events() -> Chunks:
        return (_mended(chunk, mistakes) for chunk in opened())

    layout = f"{recording.layout} ({mistakes})"
    return replace(recording, events=events, size=size, layout=layout)


def _mended(events: EventStream, mistakes: AxisFixes) -> EventStream:
    x, y, width, height = events.x, events.y, events.width, events.height
    if mistakes.swap_xy:
        x, y, width, height = y, x, height, width
    if mistakes.flip_x:
        x = (width - 1 - x).astype(x.dtype)
    if mistakes.flip_y:
        y = (height - 1 - y).astype(y.dtype)
    p = (-events.p).astype(np.int8) if mistakes.flip_polarity else events.p
    return replace(events, x=x, y=y, p=p, width=width, height=height)
