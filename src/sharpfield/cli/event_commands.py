"""The command that puts an event camera into a trained scene."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Int32
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tyro.conf import Positional

from sharpfield.captures.pose_file import read_poses
from sharpfield.cli.capture_commands import parse_size
from sharpfield.cli.run_commands import Device
from sharpfield.cli.runs import Opened, open_run
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream, merged
from sharpfield.core.files import replacing
from sharpfield.evaluation.event_agreement import agreement, side_by_side
from sharpfield.evaluation.event_frames import count_events, windows, write_frames
from sharpfield.evaluation.event_twin import (
    EventTwin,
    Pace,
    Viewpoint,
    filter_of,
    light_of,
    on_path,
    on_track,
    recorded_sensor,
    sized,
)
from sharpfield.simulation.event_sensor import SENSORS, SIZES, EventSensor
from sharpfield.storage.event_formats import expect_format, exporting_events
from sharpfield.storage.images import write_image

RECORDED = "recorded"
OWN_SIZE = "sensor"
PIECE_MS = 10.0
"""Events are written whenever so much time was seen, where no windows are asked for."""

Start = Annotated[float | None, tyro.conf.arg(name="from", metavar="MS")]
End = Annotated[float | None, tyro.conf.arg(name="to", metavar="MS")]
Look = Callable[[int, int], None]
Tell = Callable[[EventStream, int], EventStream]


@dataclass(frozen=True)
class Place:
    """Where the camera is, and when."""

    view: int | None = None
    """Number of a camera (track) of the capture; 0 if nothing is said."""
    trajectory: Path | None = None
    """A path of another camera: a text in TUM's format, or the trajectory.npz of a capture."""
    start_ms: Start = None
    """The camera is switched on so long after its path begins."""
    end_ms: End = None
    """And off so long after its path begins."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Pixels of the sensor, or `sensor` for those of the one that is named; as recorded if nothing
    is said."""


@dataclass(frozen=True)
class Pixels:
    """What the camera's pixels are like."""

    sensor: str = RECORDED
    """By name: ideal, dvs346, gen3-vga, gen4-hd; or recorded, ideal with the thresholds, dead time
    and colour filter that the capture states."""
    threshold: float | None = None
    """Contrast threshold of both signs, instead of the sensor's own."""
    seed: int = 0
    """Of what differs from pixel to pixel, and of noise."""
    step_ms: float = 4.0
    """Time between two rendered pictures where nothing changes."""
    shortest_ms: float = 1.0
    """And where light changes fastest."""
    most_change: float = 2.0
    """Largest change of any pixel between two pictures, in thresholds."""

    def pace(self) -> Pace:
        """Steps of time."""
        return Pace(_us(self.step_ms), self.most_change, _us(self.shortest_ms))


@dataclass(frozen=True)
class Windows:
    """What is made of the events besides."""

    frames: Annotated[float | None, tyro.conf.arg(metavar="MS")] = None
    """Write event frames of windows of this length, as arrays and pictures."""
    least_share: float = 0.0
    """Leave out of frames and pictures what is less than this share of a frame's largest count;
    0.3 as in the published figures."""
    compare: bool = False
    """Say how the events agree with those that the capture's own camera recorded."""


PLACE, PIXELS, WINDOWS = Place(), Pixels(), Windows()


def events(
    run: Positional[Path],
    out: Path,
    place: Place = PLACE,
    pixels: Pixels = PIXELS,
    extra: Windows = WINDOWS,
    capture: Path | None = None,
    device: Device = "auto",
) -> None:
    """Render the events that a camera would report in a trained scene.

    Args:
        run: Folder that `train` made.
        out: The file, FILE.h5, FILE.raw, FILE.npz or FILE.csv.
        place: Camera, path, time.
        pixels: Sensor and steps of time.
        extra: Event frames, comparison.
        capture: Where the capture is, if it moved.
        device: Where to render.
    """
    expect_format(out)
    _expect_sense(place, extra)
    console = Console()
    opened = open_run(run, capture=capture, device=device)
    seat = _seat(opened, place, pixels.sensor)
    recorded = _recorded(opened.capture, place.view or 0) if extra.compare else None
    edges = windows(*seat.span_us, _us(PIECE_MS if extra.frames is None else extra.frames))
    with _telling(console, seat.span_us) as (look, tell):
        twin = EventTwin(
            light_of(opened.model, seat, progress=look),
            seat.span_us,
            _sensor(opened.capture, pixels),
            pace=pixels.pace(),
            seed=pixels.seed,
        )
        seen = (tell(twin.until(edge), edge) for edge in edges)
        made = _written(out, twin.until(seat.span_us[0]), seen, extra)
    say = f"{made.count:,} events, from {twin.looks} pictures, are in {out}"
    console.print(say, highlight=False)
    if extra.frames is not None:
        folder = out.with_name(f"{out.stem}-frames")
        write_frames(folder, made.counts, least_share=extra.least_share)
        console.print(f"{len(made.counts)} event frames are in {folder}", highlight=False)
    if recorded is not None:
        _compare(console, out, (made.stream, recorded), [seat.span_us[0], *edges])


@dataclass(frozen=True)
class Made:
    """What was rendered, as far as it is still needed."""

    count: int
    """Events."""
    counts: list[Int32[np.ndarray, "h w 2"]]
    """Event frames, if they are asked for."""
    stream: EventStream
    """All events, if they are to be compared."""


def _written(out: Path, first: EventStream, parts: Iterator[EventStream], extra: Windows) -> Made:
    """Write events as they come."""
    counts, kept, total = [], [first], len(first)
    with exporting_events(out, first[:0]) as append:
        append(first)
        for part in parts:
            append(part)
            total += len(part)
            if extra.frames is not None:
                counts.append(count_events(part))
            if extra.compare:
                kept.append(part)
    return Made(total, counts, merged(kept))


def _seat(opened: Opened, place: Place, sensor: str) -> Viewpoint:
    """Where to look from."""
    if place.trajectory is not None:
        seat = on_path(opened.model, *read_poses(place.trajectory))
    else:
        seat = on_track(opened.model, opened.capture, place.view or 0)
    if place.size is not None:
        seat = replace(seat, camera=sized(seat.camera, _size(place.size, sensor)))
    start, end = (None if ms is None else _us(ms) for ms in (place.start_ms, place.end_ms))
    return seat.between(start, end)


def _size(size: str, sensor: str) -> tuple[int, int]:
    if size != OWN_SIZE:
        return parse_size(size)
    if sensor not in SIZES:
        raise OptionError(
            "this sensor has no size of its own", got=sensor, do=f"name one of {', '.join(SIZES)}"
        )
    return SIZES[sensor]


def _sensor(capture: Capture, pixels: Pixels) -> EventSensor:
    """The sensor of a name, behind the capture's colour filter."""
    if pixels.sensor not in (RECORDED, *SENSORS):
        raise OptionError(
            "unknown sensor", got=pixels.sensor, do=f"use {RECORDED}, {', '.join(SENSORS)}"
        )
    if pixels.sensor == RECORDED:
        sensor = recorded_sensor(capture)
    else:
        sensor = replace(SENSORS[pixels.sensor], bayer=filter_of(capture))
    if pixels.threshold is None:
        return sensor
    return replace(sensor, threshold_on=pixels.threshold, threshold_off=pixels.threshold)


def _recorded(capture: Capture, view: int) -> EventStream:
    """What the camera of a view recorded, also if it was held out."""
    for stream in (capture.events, capture.test_events):
        if stream is not None and len(own := stream.of_track(view)):
            return own
    raise OptionError(
        "the capture has no events of this view to compare with", where=capture.name, got=view
    )


def _expect_sense(place: Place, extra: Windows) -> None:
    if place.trajectory is not None and place.view is not None:
        raise OptionError(
            "a camera follows a view of the capture or a path of its own, not both",
            got=f"--view {place.view} and --trajectory {place.trajectory}",
            do="leave one of them out",
        )
    if extra.compare and (place.trajectory is not None or place.size is not None):
        raise OptionError(
            "only a camera of the capture, at its own size, has recorded events to compare with",
            do="leave out --trajectory and --size, or --compare",
        )
    if not 0 <= extra.least_share <= 1:
        raise OptionError("a share lies between 0 and 1", got=extra.least_share)


def _compare(
    console: Console, out: Path, streams: tuple[EventStream, EventStream], edges_us: list[int]
) -> None:
    """Print how two streams agree; write it, and a picture of them, beside the events."""
    found = agreement(*streams, edges_us)
    table, picture = (out.with_name(f"{out.stem}-compare.{end}") for end in ("json", "png"))
    with replacing(table) as temporary:
        temporary.write_text(json.dumps(asdict(found), indent=2) + "\n")
    write_image(picture, side_by_side(*streams, edges_us))
    for name, value in asdict(found).items():
        shown = f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
        console.print(f"  {name:<18} {shown}", highlight=False)
    console.print(f"Recorded and rendered side by side: {picture}", highlight=False)


@contextmanager
def _telling(console: Console, span_us: tuple[int, int]) -> Iterator[tuple[Look, Tell]]:
    """Progress through time, and within a picture: what to tell of either."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} ms"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as progress:
        task = progress.add_task("rendering", total=(span_us[1] - span_us[0]) / 1000)

        def look(done: int, pixels: int) -> None:
            progress.update(task, description=f"picture {done / pixels:4.0%}")

        def tell(part: EventStream, t_us: int) -> EventStream:
            progress.update(task, completed=(t_us - span_us[0]) / 1000)
            return part

        yield look, tell


def _us(ms: float) -> int:
    return round(1000 * ms)
