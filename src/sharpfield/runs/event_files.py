"""Events of a trained scene written to files: windows of time, event frames, comparisons."""

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from sharpfield.captures.trajectory_files import read_poses
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.report.event_frames import windows
from sharpfield.runs.events import event_sensor, event_viewpoint, whole_steps
from sharpfield.runs.run import Run
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.twin.agreement import match_thresholds
from sharpfield.twin.event_twin import EventTwin, Viewpoint, light_of
from sharpfield.twin.options import ExtraOptions, PixelOptions, ViewpointOptions
from sharpfield.twin.options import microseconds as us
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

WINDOW_MS = 10.0
"""Length of the windows in which events are written, where no event frames are asked for."""


def write_events(
    opened: Run,
    out: Path,
    camera: ViewpointOptions,
    pixels: PixelOptions,
    extra: ExtraOptions,
    *,
    size: tuple[int, int] | None,
    console: Console,
) -> None:
    """Render events in windows of time, and write each as it comes.

    Args:
        opened: A trained run.
        out: Event file.
        camera: Camera, path, time.
        pixels: Sensor and time steps.
        extra: Event frames, comparison.
        size: Sensor resolution in px; None for the capture's.
        console: Where progress and results are printed.

    Raises:
        OptionError: The camera, its time, or the comparison make no sense.
    """
    path = camera.view or 0
    if camera.trajectory is not None:
        times_us, poses = read_poses(camera.trajectory)
        path = times_us.tolist(), list(poses)
    whole = event_viewpoint(opened.model, opened.capture, path, size)
    start, end = (None if ms is None else us(ms) for ms in (camera.start_ms, camera.end_ms))
    viewpoint = whole.between(start, end)
    span = _switched_on(whole, viewpoint, camera, extra)
    recorded = _recorded(opened.capture, camera, extra, viewpoint)
    edges = windows(*viewpoint.span_us, us(WINDOW_MS if extra.frames is None else extra.frames))
    sensor = event_sensor(opened.capture, pixels.sensor, pixels.threshold)
    if pixels.match:
        sensor = _matched(console, opened, pixels, viewpoint.span_us, sensor)
    outputs = EventOutputs(
        out,
        None if extra.frames is None else out.with_name(f"{out.stem}-frames"),
        extra.least_share,
        keep=recorded is not None,
    )
    with render_progress(console, span) as (look, progress):
        light = light_of(opened.model, viewpoint, subpixels=pixels.subpixels, progress=look)
        seen = whole_steps(span, whole.span_us[1], pixels.time_steps())
        twin = EventTwin(light, seen, sensor, time_steps=pixels.time_steps(), seed=pixels.seed)
        made = write_windows(
            outputs, _windows(twin, viewpoint.span_us[0], edges, progress), len(edges)
        )
    console.print(f"{made.count:,} events, from {twin.rendered} images, are in {out}")
    if outputs.frames is not None:
        console.print(f"{len(edges)} event frames are in {outputs.frames}")
    if recorded is not None:
        about = {
            "threshold_on": sensor.threshold_on,
            "threshold_off": sensor.threshold_off,
            "matched": pixels.match,
        }
        streams = made.stream, recorded
        write_comparison(console, out, streams, [viewpoint.span_us[0], *edges], about)


def _windows(
    twin: EventTwin, start_us: int, edges: list[int], progress: TimeProgress
) -> Iterator[EventStream]:
    """Nothing, once all before the start was seen in silence; then the events of each window."""
    before = twin.until(twin.span_us[0])
    for edge in windows(twin.span_us[0], start_us, us(WINDOW_MS)):
        before = twin.until(edge)
        progress(edge)
    yield before[:0]
    for edge in edges:
        yield twin.until(edge)
        progress(edge)


def _switched_on(
    whole: Viewpoint, viewpoint: Viewpoint, camera: ViewpointOptions, extra: ExtraOptions
) -> tuple[int, int]:
    """When the camera is switched on, and off."""
    first, (start, end) = whole.span_us[0], viewpoint.span_us
    if camera.on_ms is None:
        return (first if extra.compares else start), end
    on = first + us(camera.on_ms)
    if not first <= on <= start:
        raise OptionError(
            "a camera is switched on within its path, and not after its first event",
            got=f"{camera.on_ms:g} ms",
            do=f"use 0 to {(start - first) / 1000:g}",
        )
    return on, end


def _matched(
    console: Console, opened: Run, pixels: PixelOptions, span: tuple[int, int], sensor: EventSensor
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
        f"{found.unmatched / found.recorded:.1%} of them"
    )
    return matched


def _recorded(
    capture: Capture, camera: ViewpointOptions, extra: ExtraOptions, viewpoint: Viewpoint
) -> EventStream | None:
    """What to compare with, if anything; looked at before anything is rendered."""
    if not extra.compares:
        return None
    if extra.against is not None:
        recorded = events_of_file(extra.against, viewpoint.span_us, camera.view or 0)
    else:
        recorded = events_of_view(capture, camera.view or 0)
    expect_comparable(recorded, viewpoint)
    return recorded
