"""What a camera's file holds, opened but not loaded.

A *recording* is what came out of one camera: events of one sensor, frames with their exposures,
trigger edges, motion readings, each where the format has them. Nothing is read until asked for,
and everything is read in pieces, so a recording may be larger than memory. Times are whole
microseconds of the camera's own clock, as an int64; whatever wraps in the file is unwrapped.

Reading goes on as far as the data are sound. What had to be left out (a torn end, events outside
the sensor) is said once, as a `ReadLog`; a file that is no recording at all is a `CaptureError`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int8, Int64, Shaped

from sharpfield.core.capture import Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream

Chunks = Iterator[EventStream]
"""Consecutive events of one sensor, in the order of time, a bounded number at a time."""


@dataclass(frozen=True)
class Frame:
    """One image of a camera, as its file has it."""

    image: Shaped[np.ndarray, "h w *c"]
    """uint8 or uint16; grey [h w] (of a colour sensor: raw, see `Recording.bayer`) or RGB."""
    open_us: int
    """When its exposure began."""
    close_us: int
    """When its exposure ended; equal to `open_us` where the file gives only one time."""
    name: str = ""
    """Of the file it came from, where frames are files."""


@dataclass(frozen=True)
class Triggers:
    """Edges on the camera's synchronisation inputs."""

    t_us: Int64[np.ndarray, "n"]
    edge: Int8[np.ndarray, "n"]
    """+1 rising, -1 falling."""
    channel: Shaped[np.ndarray, "n"]


@dataclass
class ReadLog:
    """What was left out while reading, counted by kind.

    Events, frames and triggers are read each by itself, and as often as one likes. A reading begins
    with `anew`, and what it notes takes the place of what the reading before it had noted: however
    often a recording is read, the same is told once. So is what several readings meet, a torn end.
    """

    noted: dict[str, int] = field(default_factory=dict)
    """What was noted here, apart from readings."""
    readings: dict[str, "Trouble"] = field(default_factory=dict)
    """The latest of each kind, by name."""

    def anew(self, reading: str) -> "Trouble":
        """What takes the notes of a reading that begins: "events", "frames", "triggers"."""
        self.readings[reading] = ReadLog()
        return self.readings[reading]

    def note(self, kind: str, count: int = 1) -> None:
        """Say that something was left out, in the plural: "events outside the sensor"."""
        if count:
            self.noted[kind] = self.noted.get(kind, 0) + count

    @property
    def counts(self) -> dict[str, int]:
        """How many of each kind were left out; where readings differ, the most."""
        found = dict(self.noted)
        for reading in self.readings.values():
            for kind, count in reading.counts.items():
                found[kind] = max(found.get(kind, 0), count)
        return found

    def __str__(self) -> str:
        """One line, "3 events outside the sensor, 1 torn packets"; empty if all was sound."""
        return ", ".join(f"{count:,} {kind}" for kind, count in self.counts.items())


@dataclass(frozen=True)
class Recording:
    """A camera's file, opened."""

    path: Path
    layout: str
    """The format by its usual name: "EVT3", "AEDAT4", "ROS1 bag" ..."""
    size: tuple[int, int] | None = None
    """Width and height of the event sensor in pixels; None where neither file nor caller says."""
    events: Callable[[], Chunks] | None = None
    """Starts reading the events; None if the format has none. Each call starts anew."""
    frames: Callable[[], Iterator[Frame]] | None = None
    """Starts reading the frames; None if there are none."""
    triggers: Callable[[], Triggers] | None = None
    """Reads the trigger edges; None if the format has none."""
    bayer: str = ""
    """Colour filter tile of the raw sensor, e.g. "RGGB"; "" if mono or not known."""
    thresholds: Thresholds | None = None
    """Contrast thresholds, where the file states them."""
    frame_encoding: str = ""
    """How values of frames relate to light (see `core.frames.ENCODINGS`); "" if not known."""
    trouble: ReadLog = field(default_factory=ReadLog)
    """What reading has left out so far; reading again tells the same, and not twice as much."""
    notes: dict[str, str] = field(default_factory=dict)
    """What the header says besides: camera, serial number, date, as the file spells it."""

    def chunks(self) -> Chunks:
        """Consecutive events, in bounded memory.

        Raises:
            CaptureError: There are none in this kind of file, or they are unsound from the start.
        """
        if self.events is None:
            raise CaptureError("the recording holds no events", where=self.path, got=self.layout)
        return self.events()

    def load(self) -> EventStream:
        """All events at once, for files that fit in memory."""
        parts = list(self.chunks())
        if not parts:
            width, height = self.size or (0, 0)
            none = np.empty(0, np.uint16)
            return EventStream(
                none, none, np.empty(0, np.int64), np.empty(0, np.int8), width, height
            )
        first = parts[0]
        return EventStream(
            x=np.concatenate([part.x for part in parts]),
            y=np.concatenate([part.y for part in parts]),
            t_us=np.concatenate([part.t_us for part in parts]),
            p=np.concatenate([part.p for part in parts]),
            width=first.width,
            height=first.height,
            bayer=first.bayer,
        )
