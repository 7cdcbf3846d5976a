"""The command that makes a capture of what a camera has recorded."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from tyro.conf import Positional

from sharpfield.cli.arguments import End, Size, Start, parse_size, screen
from sharpfield.core.errors import OptionError
from sharpfield.core.progress import progress_on
from sharpfield.preparation.ingest.ingest import Ingested, Tell
from sharpfield.preparation.ingest.ingest import ingest as ingest_recordings
from sharpfield.preparation.ingest.lens import Optics
from sharpfield.preparation.ingest.options import (
    AxisFixes,
    Cleaning,
    Crop,
    IngestOptions,
    Scene,
    Timing,
    fixed_axes,
)
from sharpfield.recordings.open import FORMATS, ReaderOptions, format_of, open_recording
from sharpfield.recordings.recording import Recording

FRAMES_ONLY = ("video", "images")
"""Formats that hold no events."""

NO_MISTAKES = AxisFixes()


@dataclass(frozen=True)
class Source:
    """What the files do not say of themselves."""

    layout: str | None = None
    """Format of the file of events; by default it is recognised. See docs/ingest.md."""
    unit: str | None = None
    """Of the times of events: ns, us, ms or s."""
    size: Size | None = None
    """Of the event sensor, in pixels."""
    topic: str | None = None
    """Which of several cameras, streams or topics."""
    image_topic: str | None = None
    """Which of several topics of images."""
    columns: str | None = None
    """What the columns of a table of events are: xytp or txyp."""
    event_encoding: str | None = None
    """Of Prophesee's RAW, where the header does not say: evt2, evt2.1, evt2.1-legacy or evt3."""
    frame_unit: str | None = None
    """Of the times of images."""
    per_second: float | None = None
    """Frames taken per second, where nothing says when they were, or the video is slow motion."""
    times: Path | None = None
    """The file that says when images were taken, where there are several."""
    mistakes: Annotated[AxisFixes, tyro.conf.arg(name="")] = NO_MISTAKES
    """Of the file, to be undone."""

    def opened(self, path: Path) -> Recording:
        """A recording, told those of the options that its format knows."""
        name = self._format(path)
        told = replace(
            ReaderOptions(),
            **{
                option: value
                for option, value in self._told(name).given().items()
                if option in FORMATS[name].takes
            },
        )
        if told.size is not None and self.mistakes.swap_xy:
            told = replace(told, size=told.size[::-1])
        return fixed_axes(open_recording(path, told, layout=name), self.mistakes)

    def expect_used(self, paths: tuple[Path, ...]) -> None:
        """Refuse options that none of the formats knows: they would have no effect.

        Raises:
            OptionError: There is one.
        """
        names = [self._format(path) for path in paths]
        given = {option for name in names for option in self._told(name).given()}
        used = {
            option
            for name in names
            for option in self._told(name).given()
            if option in FORMATS[name].takes
        }
        if useless := sorted(given - used):
            raise OptionError(
                f"the option `{useless[0]}` has no effect on these recordings",
                got=" and ".join(names),
                do="leave it out",
            )

    def _format(self, path: Path) -> str:
        """The name of a file's format; `layout` is that of events."""
        name = format_of(path) if self.layout is None else self.layout
        if self.layout is not None and path.is_dir() and format_of(path) in FRAMES_ONLY:
            name = format_of(path)
        if name not in FORMATS:
            raise OptionError("unknown format", got=name, do=f"use one of {', '.join(FORMATS)}")
        return name

    def _told(self, name: str) -> ReaderOptions:
        """What is told of a file of some format."""
        return ReaderOptions(
            unit=self.frame_unit if name in FRAMES_ONLY else self.unit,
            size=None if self.size is None else parse_size(self.size),
            topic=self.topic,
            image_topic=self.image_topic,
            columns=self.columns,
            encoding=self.event_encoding,
            per_second=self.per_second,
            times=self.times,
        )


@dataclass(frozen=True)
class Part:
    """Which part to keep, in ms from the first event."""

    start_ms: Start = None
    """Leave out what came before."""
    end_ms: End = None
    """Leave out what came after."""


SOURCE, PART = Source(), Part()
OPTICS, CLEANING, TIMING, SCENE = Optics(), Cleaning(), Timing(), Scene()


def ingest(
    recordings: Positional[tuple[Path, ...]],
    out: Path,
    source: Source = SOURCE,
    part: Part = PART,
    timing: Timing = TIMING,
    optics: Optics = OPTICS,
    cleaning: Cleaning = CLEANING,
    scene: Scene = SCENE,
) -> None:
    """Make a capture of a camera's recording, or of two: events in one file, frames in another.

    Interrupted, the same command goes on where it was.

    Args:
        recordings: Files or folders that a camera or a program has written.
        out: Folder of the capture.
        source: What the files do not say.
        part: Which part to keep.
        timing: When frames were exposed.
        optics: Lenses.
        cleaning: Events to leave out.
        scene: Poses, depth, colour.
    """
    if len(recordings) not in (1, 2):
        raise OptionError("give one recording, or two", got=len(recordings))
    console = screen()
    source.expect_used(recordings)
    opened = tuple(source.opened(path) for path in recordings)
    for recording in opened:
        console.print(f"{recording.path} is {recording.layout}")
    choices = IngestOptions(optics, cleaning, Crop(part.start_ms, part.end_ms), timing, scene)
    with _telling(console) as tell:
        made = ingest_recordings(opened, out, choices, tell)
    for line in _story(made, out):
        console.print(line, soft_wrap=True)


def _story(made: Ingested, out: Path) -> Iterator[str]:
    """What became of the recording, line by line."""
    lasts = (made.span_us[1] - made.span_us[0]) / 1e6
    yield f"{made.frames:,} frames and {made.events:,} events over {lasts:.3f} s are in {out}"
    for kind, count in made.left_out.items():
        yield f"  left out: {count:,} {kind}"
    if made.hot_pixels:
        yield f"  hot pixels: {made.hot_pixels:,}, listed in the note `hot_pixels`"
    if made.clock:
        yield f"  {made.clock}"
    if made.unknown:
        yield f"  not known yet: {', '.join(made.unknown)}"
    if "poses" in made.unknown:
        yield f"next: sharpfield doctor {out}, then sharpfield poses {out} --out {out}-posed"


@contextmanager
def _telling(console: Console) -> Iterator[Tell]:
    """Progress: a line for each thing that is being done."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    with progress_on(console, *columns) as progress:

        def tell(doing: str, done: int, total: int | None) -> None:
            if doing not in tasks:
                tasks[doing] = progress.add_task(doing, total=total)
            progress.update(tasks[doing], completed=done, total=total)

        yield tell
