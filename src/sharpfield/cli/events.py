"""The command that puts an event camera into a trained scene."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from tyro.conf import Positional

from sharpfield.captures.paths.pose_file import read_poses
from sharpfield.cli.arguments import Device, End, Size, Start, parse_size, screen
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.report.event_frames import windows
from sharpfield.runs.events import RECORDED, event_sensor, whole_steps
from sharpfield.runs.run import Run, open_run
from sharpfield.simulation.sensors.event_pixels import SIZES, EventSensor
from sharpfield.storage.event_formats import expect_format
from sharpfield.twin.event_twin import (
    EventTwin,
    TimeSteps,
    Viewpoint,
    light_of,
    path_viewpoint,
    resized_camera,
    track_viewpoint,
)
from sharpfield.twin.match import match_thresholds
from sharpfield.twin.output import (
    EventOutputs,
    TimeProgress,
    events_of_file,
    events_of_view,
    expect_comparable,
    render_progress,
    write_comparison,
    write_windows,
)

OWN_SIZE = "sensor"
PIECE_MS = 10.0
"""Events are written whenever so much time was seen, where no windows are asked for."""

On = Annotated[float | None, tyro.conf.arg(name="on", metavar="MS")]


@dataclass(frozen=True)
class Place:
    """Where the camera is, and when."""

    view: int | None = None
    """Number of a camera (track) of the capture; 0 if nothing is said."""
    trajectory: Path | None = None
    """A path of another camera: a text in TUM's format, or the trajectory.npz of a capture."""
    start_ms: Start = None
    """Its events begin so long after its path."""
    end_ms: End = None
    """And end so long after its path begins."""
    on_ms: On = None
    """Switched on already then, in silence, so that its pixels carry levels of their own; if
    nothing is said, when its events begin, or with a comparison as early as its path."""
    size: Size | None = None
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
    match: bool = False
    """Change the thresholds so that the scene makes as many events as were recorded, outside the
    time that is rendered."""
    seed: int = 0
    """Of what differs from pixel to pixel, and of noise."""
    subpixels: int = 1
    """Along each side of a pixel, whose light is their mean."""
    step_ms: float = 4.0
    """Time between two rendered images where nothing changes."""
    shortest_ms: float = 1.0
    """And where light changes fastest."""
    most_change: float = 2.0
    """Largest change of any pixel between two images, in thresholds."""

    def time_steps(self) -> TimeSteps:
        """Steps of time."""
        return TimeSteps(us(self.step_ms), self.most_change, us(self.shortest_ms))


@dataclass(frozen=True)
class Windows:
    """What is made of the events besides."""

    frames: Annotated[float | None, tyro.conf.arg(metavar="MS")] = None
    """Write event frames of windows of this length, as arrays and images."""
    least_share: float = 0.0
    """Leave out of frames and images what is less than this share of a frame's largest count;
    0.3 as in the published figures."""
    compare: bool = False
    """Say how the events agree with those that the capture's own camera recorded."""
    against: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Say how they agree with the events of a file, on the clock of the capture."""

    @property
    def compares(self) -> bool:
        """Whether anything is compared."""
        return self.compare or self.against is not None


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
    console = screen()
    opened = open_run(run, capture=capture, device=device)
    whole = _seat(opened, place, pixels.sensor)
    seat = whole.between(*_ends(place))
    span = _switched_on(whole, seat, place, extra)
    recorded = _recorded(opened.capture, place, extra, seat)
    edges = windows(*seat.span_us, us(PIECE_MS if extra.frames is None else extra.frames))
    sensor = event_sensor(opened.capture, pixels.sensor, pixels.threshold)
    if pixels.match:
        sensor = _matched(console, opened, pixels, seat.span_us, sensor)
    wanted = EventOutputs(
        out,
        None if extra.frames is None else out.with_name(f"{out.stem}-frames"),
        extra.least_share,
        keep=recorded is not None,
    )
    with render_progress(console, span) as (look, tell):
        light = light_of(opened.model, seat, subpixels=pixels.subpixels, progress=look)
        seen = whole_steps(span, whole.span_us[1], pixels.time_steps())
        twin = EventTwin(light, seen, sensor, time_steps=pixels.time_steps(), seed=pixels.seed)
        made = write_windows(wanted, _parts(twin, seat.span_us[0], edges, tell), len(edges))
    say = f"{made.count:,} events, from {twin.rendered} images, are in {out}"
    console.print(say)
    if wanted.frames is not None:
        console.print(f"{len(edges)} event frames are in {wanted.frames}")
    if recorded is not None:
        about = {
            "threshold_on": sensor.threshold_on,
            "threshold_off": sensor.threshold_off,
            "matched": pixels.match,
        }
        streams = made.stream, recorded
        write_comparison(console, out, streams, [seat.span_us[0], *edges], about)


def _parts(
    twin: EventTwin, start_us: int, edges: list[int], tell: TimeProgress
) -> Iterator[EventStream]:
    """Nothing, once all before the start was seen in silence; then the events of each window."""
    before = twin.until(twin.span_us[0])
    for edge in windows(twin.span_us[0], start_us, us(PIECE_MS)):
        before = twin.until(edge)
        tell(edge)
    yield before[:0]
    for edge in edges:
        yield twin.until(edge)
        tell(edge)


def _seat(opened: Run, place: Place, sensor: str) -> Viewpoint:
    """Where to look from, as long as the camera's path lasts."""
    if place.trajectory is not None:
        seat = path_viewpoint(opened.model, *read_poses(place.trajectory))
    else:
        seat = track_viewpoint(opened.model, opened.capture, place.view or 0)
    if place.size is None:
        return seat
    return replace(seat, camera=resized_camera(seat.camera, _size(place.size, sensor)))


def _ends(place: Place) -> tuple[int | None, int | None]:
    start, end = (None if ms is None else us(ms) for ms in (place.start_ms, place.end_ms))
    return start, end


def _switched_on(
    whole: Viewpoint, seat: Viewpoint, place: Place, extra: Windows
) -> tuple[int, int]:
    """When the camera is switched on, and off."""
    first, (start, end) = whole.span_us[0], seat.span_us
    if place.on_ms is None:
        return (first if extra.compares else start), end
    on = first + us(place.on_ms)
    if not first <= on <= start:
        raise OptionError(
            "a camera is switched on within its path, and not after its first event",
            got=f"{place.on_ms:g} ms",
            do=f"use 0 to {(start - first) / 1000:g}",
        )
    return on, end


def _matched(
    console: Console, opened: Run, pixels: Pixels, span: tuple[int, int], sensor: EventSensor
) -> EventSensor:
    """The sensor with thresholds that fit the scene; says what was found."""
    found = match_thresholds(
        opened.model,
        opened.capture,
        away_from=span,
        subpixels=pixels.subpixels,
        time_steps=pixels.time_steps(),
    )
    matched = found.applied(sensor)
    console.print(
        f"Thresholds x {found.on:.3f} to brighter, x {found.off:.3f} to darker match "
        f"{found.recorded:,} recorded events outside the time rendered; without, the scene makes "
        f"{found.unmatched / found.recorded:.1%} of them",
    )
    return matched


def _size(size: str, sensor: str) -> tuple[int, int]:
    if size != OWN_SIZE:
        return parse_size(size)
    if sensor not in SIZES:
        raise OptionError(
            "this sensor has no size of its own", got=sensor, do=f"name one of {', '.join(SIZES)}"
        )
    return SIZES[sensor]


def _recorded(
    capture: Capture, place: Place, extra: Windows, seat: Viewpoint
) -> EventStream | None:
    """What to compare with, if anything; looked at before anything is rendered."""
    if not extra.compares:
        return None
    if extra.against is not None:
        recorded = events_of_file(extra.against, seat.span_us, place.view or 0)
    else:
        recorded = events_of_view(capture, place.view or 0)
    expect_comparable(recorded, seat)
    return recorded


def _expect_sense(place: Place, extra: Windows) -> None:
    if place.trajectory is not None and place.view is not None:
        raise OptionError(
            "a camera follows a view of the capture or a path of its own, not both",
            got=f"--view {place.view} and --trajectory {place.trajectory}",
            do="leave one of them out",
        )
    if extra.compare and extra.against is not None:
        raise OptionError(
            "events are compared with the capture's or with those of a file, not with both",
            do="leave out --compare or --against",
        )
    if extra.compare and (place.trajectory is not None or place.size is not None):
        raise OptionError(
            "only a camera of the capture, at its own size, has recorded events to compare with",
            do="leave out --trajectory and --size, or name a recording with --against",
        )
    if not 0 <= extra.least_share <= 1:
        raise OptionError("a share lies between 0 and 1", got=extra.least_share)


def us(ms: float) -> int:
    """Milliseconds in whole microseconds."""
    return round(1000 * ms)
