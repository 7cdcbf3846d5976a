"""A digital twin of an event camera: the events that it would report in a trained scene.

The twin looks at light rendered from a model wherever its camera is at each instant, and its pixels
do what those of a simulated sensor do. Between two instants log intensity is taken to be straight,
so a crossing falls at the exact time on that line; instants come closer where light changes much.

    path      where the camera is at any time, in the model's world
    span      from when the camera is switched on to when it is switched off

A pixel compares with the level of its own last event, however long ago: what `until` tells in many
windows is, event by event, what it tells in one.

A pixel gathers light over its whole area. Gaussians are drawn so much wider than they are; rays see
a point. `subpixels` takes means over a larger image instead.

Source: ESIM (Rebecq et al., CoRL 2018) for events from rendered light; EvDNeRF (WACV 2024) for
rendering it from a learned scene, there as the change between two instants only.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.device import device_of
from sharpfield.core.errors import OptionError, RunError
from sharpfield.core.events import EventStream
from sharpfield.core.protocols import Model, Trajectory
from sharpfield.geometry.normalise import change_of
from sharpfield.geometry.trajectory import Moved, Stamped, count_tracks
from sharpfield.rendering.view import Progress, ViewRenderer, render_view, renderer_of
from sharpfield.simulation.sensors.event_pixels import EventSensor, brightness
from sharpfield.simulation.sensors.events import EventPixels, Gap, joined, watch

Draw = Callable[[int], Float32[np.ndarray, "h w c"] | Float32[np.ndarray, "h w"]]
"""Linear light at a time in us; the same whenever it is asked."""

BEHIND_FILTERS = "RGGB"
"""Colour filter tile of a Color-DAVIS346, for events whose positions were rectified."""


@dataclass(frozen=True)
class Pace:
    """How finely time is stepped."""

    step_us: int = 4000
    """From one instant to the next where nothing changes."""
    most_change: float = 2.0
    """Largest change of any pixel's log intensity in a step, in thresholds: where it is exceeded,
    the step is halved."""
    shortest_us: int = 1000
    """No step is made shorter than this."""

    def __post_init__(self) -> None:
        if not (self.step_us >= 1 and self.shortest_us >= 1 and self.most_change > 0):
            raise OptionError(
                "steps of time and the change of light in one must be positive",
                got=f"{self.step_us} us, {self.shortest_us} us, {self.most_change} thresholds",
            )


PACE = Pace()


class EventTwin:
    """An event camera in front of rendered light; asked for its events window by window.

    Args:
        draw: The light.
        span_us: When the camera is switched on, and off.
        sensor: Its pixels.
        pace: Steps of time. They are counted from the start of the span, not of a window.
        seed: Of what differs from pixel to pixel, and of noise.
    """

    def __init__(
        self,
        draw: Draw,
        span_us: tuple[int, int],
        sensor: EventSensor,
        *,
        pace: Pace = PACE,
        seed: int = 0,
    ) -> None:
        self.sensor, self.span_us = sensor, span_us
        self._pixels = EventPixels(sensor, seed)
        self._images = images(draw, span_us, sensor, pace)
        self.looks = 0
        """Images seen."""
        self._last_us = span_us[0] - 1
        self._size = (0, 0)
        self._held: list[Gap] = []

    def until(self, t_us: int) -> EventStream:
        """All events before a time that were not told yet.

        Args:
            t_us: Not before the time asked for last; after the span it is as its end, but for
                events on the end itself, which then count.
        """
        while self._last_us < min(t_us, self.span_us[1]):
            self._last_us, light = next(self._images)
            self._size = light.shape[1], light.shape[0]
            self._held.append(self._pixels.see(light, 1000 * self._last_us))
            self.looks += 1
        found = joined(self._held, self._size, bayer=self.sensor.bayer)
        told = int(np.searchsorted(found.t_us, t_us))
        rest = found[told:]
        self._held = [Gap(rest.x, rest.y, rest.t_us, rest.p)]
        return found[:told]


def images(
    draw: Draw, span_us: tuple[int, int], sensor: EventSensor, pace: Pace
) -> Iterator[tuple[int, Float32[np.ndarray, "h w"]]]:
    """Times in us, and what falls on each pixel then, from the start of a span to its end.

    Raises:
        OptionError: The span is empty.
    """
    start, end = span_us
    if end <= start:
        raise OptionError("a stretch of time must end after its start", got=f"{span_us} us")
    return watch(
        lambda t_us: brightness(_in_colour(draw(t_us)), sensor.bayer),
        np.append(np.arange(start, end, pace.step_us, dtype=np.int64), end),
        most_change=pace.most_change * min(sensor.threshold_on, sensor.threshold_off),
        shortest_us=pace.shortest_us,
        floor=sensor.floor,
    )


@runtime_checkable
class ManyLenses(Protocol):
    """A model of whole views that can also be seen through another camera than its capture's."""

    def through(self, camera: Camera) -> ViewRenderer:
        """The same scene through another lens, or with other pixels."""
        ...


@dataclass(frozen=True)
class Viewpoint:
    """Where the twin's camera is, and when."""

    camera: Camera
    path: Trajectory
    """In the model's world."""
    track: int
    """Of the path."""
    span_us: tuple[int, int]
    """When the camera is known to be somewhere, on the clock of the capture."""

    def between(self, start_us: int | None, end_us: int | None) -> "Viewpoint":
        """A part of it; times count from the start of the span.

        Raises:
            OptionError: The part is empty, or not within the span.
        """
        first, last = self.span_us
        start = first if start_us is None else first + start_us
        end = last if end_us is None else first + end_us
        if not first <= start < end <= last:
            raise OptionError(
                "the window of time is empty, or not within the camera's path",
                got=f"from {(start - first) / 1000:g} to {(end - first) / 1000:g} ms",
                do=f"use times from 0 to {(last - first) / 1000:g} ms, after the path's start",
            )
        return replace(self, span_us=(start, end))


def on_track(model: Model, capture: Capture, track: int) -> Viewpoint:
    """A camera of the capture itself, along its own path.

    Args:
        model: Trained.
        capture: What it was trained on, as read.
        track: Which camera.

    Raises:
        OptionError: There is no such camera.
    """
    tracks = count_tracks(capture.trajectory)
    if not 0 <= track < tracks:
        raise OptionError(
            "no such view", where=capture.name, got=track, do=f"use a number from 0 to {tracks - 1}"
        )
    clock = capture.clock
    span = capture.trajectory.known_us(track)
    span = span or (clock.origin_us, clock.origin_us + clock.span_us)
    return Viewpoint(model.capture.camera, model.capture.trajectory, track, span)


def on_path(
    model: Model, times_us: Int64[np.ndarray, "p"], poses: Float64[np.ndarray, "p 3 4"]
) -> Viewpoint:
    """A camera that goes where none went.

    Args:
        model: Trained; its scene stands still before and after the time of its capture.
        times_us: On the clock of the capture, ascending.
        poses: World-from-camera, in the capture's own world.

    Raises:
        CaptureError: Times do not ascend, or a pose is none.
        OptionError: There are fewer than two poses.
    """
    if len(times_us) < 2:
        raise OptionError("a path needs at least two poses", got=len(times_us))
    stamped = Stamped(times_us, poses, model.capture.clock)
    path = Moved(stamped, change_of(model.capture)).to(device_of(model.capture.trajectory))
    return Viewpoint(model.capture.camera, path, 0, stamped.known_us(0))


def light_of(
    model: Any,
    seat: Viewpoint,
    *,
    subpixels: int = 1,
    progress: Progress | None = None,
) -> Draw:
    """The light that a model sends to a viewpoint.

    Args:
        model: Trained; of rays or of whole views.
        seat: Where to look from.
        subpixels: How many times wider and higher the image is whose means are taken.
        progress: Told how much of a image is done.

    Raises:
        OptionError: The model cannot be seen through this camera, or there are no subpixels.
    """
    if subpixels < 1:
        raise OptionError("a pixel has at least one part", got=f"{subpixels} subpixels")
    width, height = seat.camera.size
    camera = sized(seat.camera, (subpixels * width, subpixels * height))
    renderer = _renderer(model, camera)
    clock, home = model.capture.clock, device_of(seat.path)
    track = torch.tensor(seat.track, device=home)

    @torch.no_grad()
    def draw(t_us: int) -> Float32[np.ndarray, "h w c"]:
        time = float(clock.unit(t_us))
        pose = seat.path.pose(torch.tensor(time, device=home), track).detach()
        lit = min(max(time, 0.0), 1.0)
        rgb = render_view(renderer, camera, pose, lit, progress=progress).rgb.numpy()
        if not np.isfinite(rgb).all():
            raise RunError(
                "the model sends light that is not a number",
                got=f"at {t_us} us",
                do="train it again, at a lower rate",
            )
        parts = np.maximum(rgb, 0).reshape(height, subpixels, width, subpixels, -1)
        return parts.mean((1, 3), dtype=np.float32)

    return draw


def recorded_sensor(capture: Capture) -> EventSensor:
    """Ideal pixels, with the thresholds, dead time and colour filter that a capture states."""
    known = capture.known
    stated = {"refractory_us": known.refractory_us, "floor": known.log_floor}
    if known.thresholds is not None:
        stated |= {"threshold_off": known.thresholds.negative}
        stated |= {"threshold_on": known.thresholds.positive}
    stated = {name: value for name, value in stated.items() if value is not None}
    return replace(EventSensor(), **stated, refractory_rule="reset", bayer=filter_of(capture))


def filter_of(capture: Capture) -> str:
    """The colour filter tile of a capture's event camera; "" for a grey one."""
    events = capture.events if capture.events is not None else capture.test_events
    if events is None:
        return ""
    return events.bayer or (BEHIND_FILTERS if events.coloured else "")


def sized(camera: Camera, size: tuple[int, int]) -> Camera:
    """A camera with other pixels, that sees no more than the same: scaled, and cut evenly."""
    factor = max(size[0] / camera.width, size[1] / camera.height)
    large = camera.scaled(factor)
    return replace(
        large,
        width=size[0],
        height=size[1],
        cx_px=large.cx_px - (large.width - size[0]) / 2,
        cy_px=large.cy_px - (large.height - size[1]) / 2,
    )


def _renderer(model: Any, camera: Camera) -> Any:
    draw = renderer_of(model)
    if not isinstance(draw, ViewRenderer) or camera == model.capture.camera:
        return draw
    if isinstance(draw, ManyLenses):
        return draw.through(camera)
    raise OptionError(
        "this model draws the views of its capture's camera only",
        got=f"{camera.width}x{camera.height}",
        do="leave the size as it was recorded",
    )


def _in_colour(light: np.ndarray) -> np.ndarray:
    """Three channels, or none: a grey model may send light in one."""
    return light[..., 0] if light.ndim == 3 and light.shape[-1] == 1 else light
