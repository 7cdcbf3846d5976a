"""A camera recording: opened, but not loaded.

A *recording* is the output of one camera: events of one sensor, frames with their exposures, and
trigger edges, each where the format has them. Nothing is read before it is asked for, and
everything is read in chunks, so a recording may be larger than memory. Times are int64
microseconds of the camera's own clock; counters that wrap in the file are unwrapped.

Readers go as far as the data are valid. What they leave out (a truncated end, events outside the
sensor) is counted in a `ReadLog`; a file that is no recording at all raises a `CaptureError`.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int8, Int64, Shaped

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream

Chunks = Iterator[EventStream]
"""Consecutive events of one sensor, sorted by time, a bounded number at a time."""


@dataclass(frozen=True)
class Frame:
    """One image of a camera, as stored in the file."""

    image: Shaped[np.ndarray, "h w *c"]
    """uint8 or uint16: [h w] grey, or raw behind a colour filter, see `Recording.bayer`; or [h w 3]
    RGB."""
    open_us: int
    """Start of the exposure."""
    close_us: int
    """End of the exposure; equal to `open_us` where the file gives only one time."""
    name: str = ""
    """Name of the image file, where each frame is a file."""


@dataclass(frozen=True)
class Triggers:
    """Edges on the camera's synchronisation inputs."""

    t_us: Int64[np.ndarray, "n"]
    edge: Int8[np.ndarray, "n"]
    """+1 rising, -1 falling."""
    channel: Shaped[np.ndarray, "n"]


@dataclass
class ReadLog:
    """Counts of what was left out while reading, by kind.

    Events, frames and triggers are read in separate passes, each any number of times. A pass begins
    with `start`, and its counts replace those of the previous pass of the same name, so reading
    twice does not count twice. What several passes meet, such as a truncated end, counts once.
    """

    own: dict[str, int] = field(default_factory=dict)
    """Counts that belong to no pass."""
    passes: dict[str, "ReadLog"] = field(default_factory=dict)
    """Log of the latest pass, by name."""

    def start(self, name: str) -> "ReadLog":
        """The log of a new pass: "events", "frames" or "triggers"."""
        self.passes[name] = ReadLog()
        return self.passes[name]

    def note(self, kind: str, count: int = 1) -> None:
        """Count something left out; `kind` is a plural, "events outside the sensor"."""
        if count:
            self.own[kind] = self.own.get(kind, 0) + count

    @property
    def counts(self) -> dict[str, int]:
        """How many of each kind were left out; the largest count where passes differ."""
        total = dict(self.own)
        for one in self.passes.values():
            for kind, count in one.counts.items():
                total[kind] = max(total.get(kind, 0), count)
        return total

    def __str__(self) -> str:
        """One line, "3 events outside the sensor, 1 truncated packets"; empty without any."""
        return ", ".join(f"{count:,} {kind}" for kind, count in self.counts.items())


@dataclass(frozen=True)
class Recording:
    """An opened recording."""

    path: Path
    layout: str
    """Usual name of the format: "EVT3", "AEDAT4", "ROS1 bag" ..."""
    size: tuple[int, int] | None = None
    """Resolution of the event sensor, width and height; None if it is unknown."""
    events: Callable[[], Chunks] | None = None
    """Reads the events from the beginning at each call; None if there are none."""
    frames: Callable[[], Iterator[Frame]] | None = None
    """Reads the frames from the beginning at each call; None if there are none."""
    triggers: Callable[[], Triggers] | None = None
    """Reads the trigger edges; None if there are none."""
    bayer: str = ""
    """Colour filter array of the raw sensor, e.g. "RGGB"; "" if monochrome or unknown."""
    thresholds: tuple[float, float] | None = None
    """Contrast thresholds in natural log, negative and positive, where the file gives them."""
    frame_encoding: str = ""
    """How pixel values relate to light (see `core.frames.ENCODINGS`); "" if unknown."""
    log: ReadLog = field(default_factory=ReadLog)
    """What reading has left out so far."""
    notes: dict[str, str] = field(default_factory=dict)
    """Other header entries as the file spells them: camera, serial number, date."""

    def chunks(self) -> Chunks:
        """Consecutive events, in bounded memory.

        Raises:
            CaptureError: The recording holds no events, or they are invalid from the start.
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
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("x", "y", "t_us", "p")
        }
        return replace(parts[0], **columns)


@dataclass(frozen=True)
class ReaderOptions:
    """What the user knows about a recording and its file does not say; None leaves it to the file.

    A new option is a field here, and its name in the `Format.options` of the readers that use it.
    """

    unit: str | None = None
    """Unit of the event times: ns, us, ms or s."""
    size: tuple[int, int] | None = None
    """Resolution of the event sensor in pixels, width and height."""
    topic: str | None = None
    """Which of several cameras, streams or topics to take the events from."""
    image_topic: str | None = None
    """Which of several topics or cameras to take the images from; an empty text for none."""
    columns: str | None = None
    """Order of the columns in a table of events: xytp or txyp."""
    event_encoding: str | None = None
    """Encoding of a Prophesee RAW file: evt2, evt2.1, evt2.1-legacy or evt3."""
    frame_unit: str | None = None
    """Unit of the image times: ns, us, ms or s."""
    fps: float | None = None
    """Frames recorded per second, where no file gives their times, or a video is slow motion."""
    times: Path | None = None
    """The file with the image times, where there are several candidates."""

    def given(self) -> dict[str, Any]:
        """The options that were given, by name; those of a subclass are not among them."""
        values = {name: getattr(self, name) for name in ReaderOptions.__dataclass_fields__}
        return {name: value for name, value in values.items() if value is not None}

    def only(self, names: Collection[str]) -> "ReaderOptions":
        """These options without all others."""
        return ReaderOptions(**{k: v for k, v in self.given().items() if k in names})


NO_OPTIONS = ReaderOptions()


@dataclass(frozen=True)
class Format:
    """A kind of file that cameras and programs write."""

    name: str
    open: Callable[[Path, ReaderOptions], Recording]
    """Opens a file or folder of this format."""
    holds: str
    """Which data it holds, in words."""
    marks: str
    """How it is recognised, in words."""
    recognise: Callable[[Path, bytes], bool] = lambda path, head: False
    """Whether a path is of this format; takes the first bytes of the file, b"" for a folder."""
    suffixes: tuple[str, ...] = ()
    """File name suffixes that decide where no content does, in small letters."""
    options: tuple[str, ...] = ("size",)
    """Fields of `ReaderOptions` that `open` uses."""


def begins_with(*signatures: bytes) -> Callable[[Path, bytes], bool]:
    """Recognises files by their first bytes."""
    return lambda path, head: head.startswith(signatures)
