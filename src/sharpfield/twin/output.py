"""Output of rendered events: event files written window by window, event frames, comparisons."""

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
from sharpfield.core.files import write_json
from sharpfield.core.progress import progress_on
from sharpfield.recordings.open import open_recording
from sharpfield.report.event_frames import count_events, writing_frames
from sharpfield.storage.event_writer import exporting_events
from sharpfield.storage.images import write_image
from sharpfield.twin.agreement import busiest_window, compare_events
from sharpfield.twin.event_twin import Viewpoint

ImageProgress = Callable[[int, int], None]
"""Called with the pixels of an image that are rendered, and all."""
TimeProgress = Callable[[int], None]
"""Called with the time in us that is reached."""


@dataclass(frozen=True)
class EventOutputs:
    """What is written of an event stream."""

    out: Path
    """Event file."""
    frames: Path | None = None
    """Folder of event frames."""
    least_share: float = 0.0
    """Pixels with a smaller share of the largest count are left out of event frames."""
    keep: bool = False
    """Whether to return all events."""


@dataclass(frozen=True)
class WrittenEvents:
    """Number of events written, and the events if they were kept."""

    count: int
    """Number of events."""
    stream: EventStream
    """All events if they were kept, else none."""


def write_windows(
    outputs: EventOutputs, parts: Iterator[EventStream], number: int
) -> WrittenEvents:
    """Write the events of one window after the other.

    Args:
        outputs: Files to write.
        parts: First an empty stream that describes the sensor, then one for each window.
        number: Number of windows.
    """
    first = next(parts)
    kept, total = [first], 0
    with ExitStack() as open_files:
        append = open_files.enter_context(exporting_events(outputs.out, first))
        count = None
        if outputs.frames is not None:
            frames = writing_frames(outputs.frames, number, least_share=outputs.least_share)
            count = open_files.enter_context(frames)
        for part in parts:
            append(part)
            total += len(part)
            if count is not None:
                count(count_events(part))
            if outputs.keep:
                kept.append(part)
    return WrittenEvents(total, merged(kept))


def events_of_view(capture: Capture, view: int) -> EventStream:
    """Recorded events of the camera of a view, also if it was held out.

    Raises:
        OptionError: The capture has no events of this view.
    """
    for stream in (capture.events, capture.test_events):
        if stream is not None and len(own := stream.of_track(view)):
            return own
    raise OptionError(
        "the capture has no events of this view to compare with", where=capture.name, got=view
    )


def events_of_file(path: Path, span_us: tuple[int, int], view: int) -> EventStream:
    """Events of a file in a time span, both ends included; of a camera rig, those of a view.

    Raises:
        CaptureError: It is not an event file, or has no events in the time span.
    """
    found = []
    for part in open_recording(path).chunks():
        if part.t_us[0] > span_us[1]:
            break
        own = part.window(span_us[0], span_us[1] + 1)
        found.append(own if own.track is None else own.of_track(view))
    if not sum(map(len, found)):
        raise CaptureError(
            "the recording has no events in the time that is rendered",
            where=path,
            got=f"from {span_us[0]} to {span_us[1]} us, view {view}",
            do="times of the file must be on the clock of the capture; of a rig, --view is used",
        )
    return merged(found)


def expect_comparable(recorded: EventStream, view: Viewpoint) -> None:
    """Check that a recording has the rendered pixels, and events in the rendered time.

    Raises:
        OptionError: It has not.
    """
    if (size := (recorded.width, recorded.height)) != view.camera.size:
        raise OptionError(
            "the two sensors differ in size", got=f"{size} recorded, {view.camera.size} rendered"
        )
    if not len(recorded.window(*view.span_us)):
        raise OptionError(
            "this camera has no recorded events in the time that is rendered",
            got=f"from {view.span_us[0]} to {view.span_us[1]} us",
            do="name another time with --from and --to",
        )


def write_comparison(
    console: Console,
    out: Path,
    streams: tuple[EventStream, EventStream],
    edges_us: list[int],
    about: dict[str, Any],
) -> None:
    """Print the metrics of two streams; write them, and event frames of both, beside `out`.

    Args:
        console: Where to print.
        out: Event file.
        streams: Rendered, recorded.
        edges_us: Boundaries of the windows.
        about: Further entries of the JSON file.
    """
    found = {
        name: value if math.isfinite(value) else None
        for name, value in asdict(compare_events(*streams, edges_us)).items()
    }
    table, image = (out.with_name(f"{out.stem}-compare.{end}") for end in ("json", "png"))
    write_json(table, found | about, allow_nan=False)
    write_image(image, busiest_window(*streams, edges_us))
    for name, value in found.items():
        shown = "-" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
        console.print(f"  {name:<18} {shown}")
    console.print(f"Recorded and rendered side by side: {image}")


@contextmanager
def render_progress(
    console: Console, span_us: tuple[int, int]
) -> Iterator[tuple[ImageProgress, TimeProgress]]:
    """A progress bar over time and within an image; gives a callback for each."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} ms"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with progress_on(console, *columns) as progress:
        task = progress.add_task("rendering", total=(span_us[1] - span_us[0]) / 1000)
        yield (
            lambda done, pixels: progress.update(task, description=f"image {done / pixels:4.0%}"),
            lambda t_us: progress.update(task, completed=(t_us - span_us[0]) / 1000),
        )
