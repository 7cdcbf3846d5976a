"""What the `events` command writes and prints: streams as they come, frames, comparisons."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream, merged
from sharpfield.core.files import replacing
from sharpfield.core.progress import progress_on
from sharpfield.recordings.open import open_events
from sharpfield.report.event_frames import count_events, writing_frames
from sharpfield.storage.event_formats import exporting_events
from sharpfield.storage.images import write_image
from sharpfield.twin.agreement import agreement, side_by_side
from sharpfield.twin.twin import Viewpoint

Look = Callable[[int, int], None]
Tell = Callable[[int], None]


@dataclass(frozen=True)
class Wanted:
    """What is to be written of a stream."""

    out: Path
    frames: Path | None = None
    """Folder of event frames."""
    least_share: float = 0.0
    keep: bool = False
    """Whether all events are needed at the end."""


@dataclass(frozen=True)
class Made:
    """What was rendered, as far as it is still needed."""

    count: int
    """Events."""
    stream: EventStream
    """All events, if they were to be kept."""


def write_parts(wanted: Wanted, parts: Iterator[EventStream], number: int) -> Made:
    """Write events of one window after the other as they come.

    Args:
        wanted: Where.
        parts: First an empty one, which says what the sensor is like; then one for each window.
        number: Of windows.
    """
    first = next(parts)
    kept, total = [first], 0
    with ExitStack() as open_files:
        append = open_files.enter_context(exporting_events(wanted.out, first))
        count = None
        if wanted.frames is not None:
            frames = writing_frames(wanted.frames, number, least_share=wanted.least_share)
            count = open_files.enter_context(frames)
        for part in parts:
            append(part)
            total += len(part)
            if count is not None:
                count(count_events(part))
            if wanted.keep:
                kept.append(part)
    return Made(total, merged(kept))


def recorded_by(capture: Capture, view: int) -> EventStream:
    """What the camera of a view recorded, also if it was held out.

    Raises:
        OptionError: The capture has no events of it.
    """
    for stream in (capture.events, capture.test_events):
        if stream is not None and len(own := stream.of_track(view)):
            return own
    raise OptionError(
        "the capture has no events of this view to compare with", where=capture.name, got=view
    )


def recorded_in(path: Path, span_us: tuple[int, int], view: int) -> EventStream:
    """The events of any file in a stretch of time, both ends included; of a rig, those of a view.

    Raises:
        CaptureError: The file is none, or has nothing then.
    """
    found = []
    for part in open_events(path).chunks():
        if part.t_us[0] > span_us[1]:
            break
        own = part.window(span_us[0], span_us[1] + 1)
        found.append(own if own.track is None else own.of_track(view))
    if not sum(map(len, found)):
        raise CaptureError(
            "nothing was recorded at the time that is rendered",
            where=path,
            got=f"from {span_us[0]} to {span_us[1]} us, view {view}",
            do="times of the file must be on the clock of the capture; of a rig, it has --view's",
        )
    return merged(found)


def expect_comparable(recorded: EventStream, seat: Viewpoint) -> None:
    """Refuse a recording that has other pixels than the twin, or nothing to say about its time.

    Raises:
        OptionError: So it is.
    """
    if (size := (recorded.width, recorded.height)) != seat.camera.size:
        raise OptionError(
            "the two sensors differ in size", got=f"{size} recorded, {seat.camera.size} rendered"
        )
    if not len(recorded.window(*seat.span_us)):
        raise OptionError(
            "nothing was recorded at the time that is rendered, by this camera",
            got=f"from {seat.span_us[0]} to {seat.span_us[1]} us",
            do="name another time with --from and --to",
        )


def compare(
    console: Console,
    out: Path,
    streams: tuple[EventStream, EventStream],
    edges_us: list[int],
    about: dict[str, Any],
) -> None:
    """Print how two streams agree; write it, and a image of them, beside the events.

    Args:
        console: Where to print.
        out: Of the events.
        streams: Rendered, recorded.
        edges_us: Where windows begin and end.
        about: What else the file of numbers should say.
    """
    found = {
        name: value if math.isfinite(value) else None
        for name, value in asdict(agreement(*streams, edges_us)).items()
    }
    table, image = (out.with_name(f"{out.stem}-compare.{end}") for end in ("json", "png"))
    with replacing(table) as temporary:
        temporary.write_text(json.dumps(found | about, indent=2, allow_nan=False) + "\n")
    write_image(image, side_by_side(*streams, edges_us))
    for name, value in found.items():
        shown = "-" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
        console.print(f"  {name:<18} {shown}")
    console.print(f"Recorded and rendered side by side: {image}")


@contextmanager
def telling(console: Console, span_us: tuple[int, int]) -> Iterator[tuple[Look, Tell]]:
    """Progress through time, and within a image: what to tell of either."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} ms"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with progress_on(console, *columns) as progress:
        task = progress.add_task("rendering", total=(span_us[1] - span_us[0]) / 1000)

        def look(done: int, pixels: int) -> None:
            progress.update(task, description=f"image {done / pixels:4.0%}")

        def tell(t_us: int) -> None:
            progress.update(task, completed=(t_us - span_us[0]) / 1000)

        yield look, tell
