"""`sharpfield ingest`: make a capture of camera recordings."""

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

from sharpfield.cli.arguments import End, Start, parse_size, screen
from sharpfield.core.errors import OptionError
from sharpfield.core.progress import progress_on
from sharpfield.preparation.ingest.options import (
    AxisFixes,
    Cleaning,
    Crop,
    IngestOptions,
    IngestSummary,
    Optics,
    Scene,
    StepProgress,
    Timing,
    fixed_axes,
)
from sharpfield.recordings.open import FORMATS, format_of, open_recording
from sharpfield.recordings.recording import Format, ReaderOptions, Recording

FRAMES_ONLY = ("video", "images")
"""Formats that hold no events."""

Size = Annotated[
    tuple[int, int],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="WxH",
        instance_from_str=lambda words: parse_size(words[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda size: [f"{size[0]}x{size[1]}"],
    ),
]
NO_FIXES = AxisFixes()


@dataclass(frozen=True)
class Source(ReaderOptions):
    """What the files do not say of themselves."""

    size: Size | None = None
    """Resolution of the event sensor in pixels."""
    layout: str | None = None
    """Format of the event file; recognised by default. See docs/ingest.md."""
    axis_fixes: Annotated[AxisFixes, tyro.conf.arg(name="")] = NO_FIXES
    """Errors of the event file to correct."""

    def opened(self, path: Path) -> Recording:
        """Open a recording with the options that its format uses, and correct its axes."""
        known = self.format(path)
        options = self.only(known.options)
        if options.size is not None and self.axis_fixes.swap_xy:
            options = replace(options, size=options.size[::-1])
        return fixed_axes(open_recording(path, options, layout=known.name), self.axis_fixes)

    def expect_used(self, paths: tuple[Path, ...]) -> None:
        """Refuse options that none of the formats uses.

        Raises:
            OptionError: There is one.
        """
        formats = [self.format(path) for path in paths]
        used = {option for known in formats for option in known.options}
        if unused := sorted(self.given().keys() - used):
            raise OptionError(
                f"the option `{unused[0]}` has no effect on these recordings",
                got=" and ".join(known.name for known in formats),
                do="leave it out",
            )

    def format(self, path: Path) -> Format:
        """Format of a file; `layout` names that of the events."""
        if self.layout is None or (path.is_dir() and format_of(path) in FRAMES_ONLY):
            return FORMATS.named(format_of(path), "format")
        return FORMATS.named(self.layout, "format")


@dataclass(frozen=True)
class Part:
    """Time range to keep, in ms from the first event."""

    start_ms: Start = None
    """Leave out everything before."""
    end_ms: End = None
    """Leave out everything after."""


SOURCE, PART = Source(), Part()
OPTICS, CLEANING, TIMING, SCENE = Optics(), Cleaning(), Timing(), Scene()


def ingest_command(
    recordings: Positional[tuple[Path, ...]],
    out: Path,
    source: Source = SOURCE,
    part: Part = PART,
    timing: Timing = TIMING,
    optics: Optics = OPTICS,
    cleaning: Cleaning = CLEANING,
    scene: Scene = SCENE,
) -> None:
    """Make a capture of one camera recording, or of two: events in one file, frames in another.

    After an interruption the same command continues where it was.

    Args:
        recordings: Files or folders that a camera or a program has written.
        out: Folder of the capture.
        source: What the files do not say of themselves.
        part: Time range to keep.
        timing: When frames were exposed.
        optics: Lens calibration.
        cleaning: Events to leave out.
        scene: Poses, depth bounds, colour.
    """
    if len(recordings) not in (1, 2):
        raise OptionError("give one recording, or two", got=len(recordings))
    console = screen()
    source.expect_used(recordings)
    opened = tuple(source.opened(path) for path in recordings)
    for recording in opened:
        console.print(f"{recording.path} is {recording.layout}")
    from sharpfield.preparation.ingest.pipeline import ingest

    options = IngestOptions(optics, cleaning, Crop(part.start_ms, part.end_ms), timing, scene)
    with _progress(console) as progress:
        ingested = ingest(opened, out, options, progress)
    for line in _summary_lines(ingested, out):
        console.print(line, soft_wrap=True)


def _summary_lines(ingested: IngestSummary, out: Path) -> Iterator[str]:
    seconds = (ingested.span_us[1] - ingested.span_us[0]) / 1e6
    counts = f"{ingested.frames:,} frames and {ingested.events:,} events"
    yield f"{counts} over {seconds:.3f} s are in {out}"
    for kind, count in ingested.left_out.items():
        yield f"  left out: {count:,} {kind}"
    if ingested.hot_pixels:
        yield f"  hot pixels: {ingested.hot_pixels:,}, listed in the note `hot_pixels`"
    if ingested.clock:
        yield f"  {ingested.clock}"
    if ingested.unknown:
        yield f"  not known yet: {', '.join(ingested.unknown)}"
    if "poses" in ingested.unknown:
        yield f"next: sharpfield doctor {out}, then sharpfield poses {out} --out {out}-posed"


@contextmanager
def _progress(console: Console) -> Iterator[StepProgress]:
    """A progress bar for each step."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    with progress_on(console, *columns) as bars:

        def update(step: str, done: int, total: int | None) -> None:
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=total)
            bars.update(tasks[step], completed=done, total=total)

        yield update
