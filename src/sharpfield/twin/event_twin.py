"""A digital twin of an event camera: the events that it would report in a trained scene.

Light is rendered from the model along the camera path, and passed to the pixels of a simulated
event sensor. Log intensity is interpolated linearly between two rendered images, which gives the
time of each threshold crossing; time steps are halved where the light changes much.

    path      pose of the camera at any time, in the model's world
    span      from when the camera is switched on to when it is switched off

Each pixel keeps the reference level of its last event: `until` gives the same events whether it is
called for many short windows or for a long one.

A pixel integrates light over its area. Gaussians are widened for that when they are rasterized;
rays sample one point of a pixel. `subpixels` renders a larger image and averages it instead.

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
from sharpfield.core.errors import OptionError, RunError
from sharpfield.core.events import EventStream
from sharpfield.core.protocols import Model, Trajectory
from sharpfield.core.struct import device_of
from sharpfield.geometry.normalise import change_of
from sharpfield.geometry.trajectory import Moved, Stamped, count_tracks
from sharpfield.rendering.view import Progress, ViewRenderer, render_view, renderer_of
from sharpfield.simulation.sensors.event_pixels import EventSensor, brightness
from sharpfield.simulation.sensors.events import EventPixels, Gap, joined, watch

LightAt = Callable[[int], Float32[np.ndarray, "h w c"] | Float32[np.ndarray, "h w"]]
"""Linear light at a time in us; always the same for the same time."""

BEHIND_FILTERS = "RGGB"
"""Colour filter tile of a Color-DAVIS346, for events whose positions were rectified."""


@dataclass(frozen=True)
class TimeSteps:
    """Time steps between rendered images."""

    step_us: int = 4000
    """Step where nothing changes."""
    most_change: float = 2.0
    """Largest change of log intensity of any pixel in a step, in thresholds; a step that exceeds it
    is halved."""
    shortest_us: int = 1000
    """Smallest step."""

    def __post_init__(self) -> None:
        if not (self.step_us >= 1 and self.shortest_us >= 1 and self.most_change > 0):
            raise OptionError(
                "time steps and the change of light in one must be positive",
                got=f"{self.step_us} us, {self.shortest_us} us, {self.most_change} thresholds",
            )


TIME_STEPS = TimeSteps()


class EventTwin:
    """An event camera in front of rendered light, simulated window by window.

    Args:
        light_at: Linear light at a time.
        span_us: When the camera is switched on, and off.
        sensor: Model of its pixels.
        time_steps: Time steps, counted from the start of the span, not of a window.
        seed: Random seed of threshold mismatch and noise.
    """

    def __init__(
        self,
        light_at: LightAt,
        span_us: tuple[int, int],
        sensor: EventSensor,
        *,
        time_steps: TimeSteps = TIME_STEPS,
        seed: int = 0,
    ) -> None:
        self.sensor, self.span_us = sensor, span_us
        self._pixels = EventPixels(sensor, seed)
        self._images = images(light_at, span_us, sensor, time_steps)
        self.rendered = 0
        """Number of images rendered."""
        self._last_us = span_us[0] - 1
        self._size = (0, 0)
        self._pending: list[Gap] = []

    def until(self, t_us: int) -> EventStream:
        """All events before a time that were not returned yet.

        Args:
            t_us: Not before the previous call's. After the end of the span the stream also holds
                events at exactly the end.
        """
        while self._last_us < min(t_us, self.span_us[1]):
            self._last_us, light = next(self._images)
            self._size = light.shape[1], light.shape[0]
            self._pending.append(self._pixels.see(light, 1000 * self._last_us))
            self.rendered += 1
        found = joined(self._pending, self._size, bayer=self.sensor.bayer)
        count = int(np.searchsorted(found.t_us, t_us))
        rest = found[count:]
        self._pending = [Gap(rest.x, rest.y, rest.t_us, rest.p)]
        return found[:count]


def images(
    light_at: LightAt, span_us: tuple[int, int], sensor: EventSensor, time_steps: TimeSteps
) -> Iterator[tuple[int, Float32[np.ndarray, "h w"]]]:
    """Times in us and the brightness of each pixel, from the start of a span to its end.

    Raises:
        OptionError: The span is empty.
    """
    start, end = span_us
    if end <= start:
        raise OptionError("a time span must end after its start", got=f"{span_us} us")

    def pixel_brightness(t_us: int) -> Float32[np.ndarray, "h w"]:
        light = light_at(t_us)  # one channel of a monochrome model: [h, w]
        single = light.ndim == 3 and light.shape[-1] == 1
        return brightness(light[..., 0] if single else light, sensor.bayer)

    return watch(
        pixel_brightness,
        np.append(np.arange(start, end, time_steps.step_us, dtype=np.int64), end),
        most_change=time_steps.most_change * min(sensor.threshold_on, sensor.threshold_off),
        shortest_us=time_steps.shortest_us,
        floor=sensor.floor,
    )


@runtime_checkable
class OtherCameras(Protocol):
    """A model of whole views that can be rendered with another camera than its capture's."""

    def through(self, camera: Camera) -> ViewRenderer:
        """The renderer for another lens or resolution."""
        ...


@dataclass(frozen=True)
class Viewpoint:
    """Camera, path and time span of the twin."""

    camera: Camera
    path: Trajectory
    """In the model's world."""
    track: int
    """Number of its track on the path."""
    span_us: tuple[int, int]
    """Time span with known poses, on the clock of the capture."""

    def between(self, start_us: int | None, end_us: int | None) -> "Viewpoint":
        """The same viewpoint in a part of the time span; times count from its start.

        Raises:
            OptionError: The part is empty, or not within the span.
        """
        first, last = self.span_us
        start = first if start_us is None else first + start_us
        end = last if end_us is None else first + end_us
        if not first <= start < end <= last:
            raise OptionError(
                "the time window is empty, or not within the camera path",
                got=f"from {(start - first) / 1000:g} to {(end - first) / 1000:g} ms",
                do=f"use times from 0 to {(last - first) / 1000:g} ms, after the start of the path",
            )
        return replace(self, span_us=(start, end))


def track_viewpoint(model: Model, capture: Capture, track: int) -> Viewpoint:
    """A camera of the capture that a model was trained on, along its own path.

    Raises:
        OptionError: There is no such camera.
    """
    tracks = count_tracks(capture.trajectory)
    if not 0 <= track < tracks:
        raise OptionError(
            "no such view", where=capture.name, got=track, do=f"use a number from 0 to {tracks - 1}"
        )
    clock = capture.clock
    all_of_it = clock.origin_us, clock.origin_us + clock.span_us
    span = capture.trajectory.known_us(track) or all_of_it
    return Viewpoint(model.capture.camera, model.capture.trajectory, track, span)


def path_viewpoint(
    model: Model, times_us: Int64[np.ndarray, "p"], poses: Float64[np.ndarray, "p 3 4"]
) -> Viewpoint:
    """The camera of the capture along another path.

    Args:
        model: Trained; its scene does not move before and after the time of its capture.
        times_us: On the clock of the capture, ascending.
        poses: World-from-camera, in the capture's own world.

    Raises:
        CaptureError: Times do not ascend, or a pose is not a rotation and a translation.
        OptionError: There are fewer than two poses.
    """
    if len(times_us) < 2:
        raise OptionError("a path needs at least two poses", got=len(times_us))
    stamped = Stamped(times_us, poses, model.capture.clock)
    path = Moved(stamped, change_of(model.capture)).to(device_of(model.capture.trajectory))
    return Viewpoint(model.capture.camera, path, 0, stamped.known_us(0))


def light_of(
    model: Any, viewpoint: Viewpoint, *, subpixels: int = 1, progress: Progress | None = None
) -> LightAt:
    """A function that renders the light of a model at a viewpoint.

    Args:
        model: Trained; renders rays or whole views.
        viewpoint: Camera and path.
        subpixels: Factor on width and height of the rendered image, which is then averaged.
        progress: Called with the pixels of an image that are rendered, and all.

    Raises:
        OptionError: The model cannot be rendered with this camera, or `subpixels` is below 1.
    """
    if subpixels < 1:
        raise OptionError("a pixel has at least one subpixel", got=f"{subpixels} subpixels")
    width, height = viewpoint.camera.size
    camera = resized_camera(viewpoint.camera, (subpixels * width, subpixels * height))
    renderer = _renderer(model, camera)
    clock, device = model.capture.clock, device_of(viewpoint.path)
    track = torch.tensor(viewpoint.track, device=device)

    @torch.no_grad()
    def light_at(t_us: int) -> Float32[np.ndarray, "h w c"]:
        time = float(clock.unit(t_us))
        pose = viewpoint.path.pose(torch.tensor(time, device=device), track).detach()
        scene_time = min(max(time, 0.0), 1.0)  # the scene does not move outside its capture
        rgb = render_view(renderer, camera, pose, scene_time, progress=progress).rgb.numpy()
        if not np.isfinite(rgb).all():
            raise RunError(
                "the model renders light that is not a finite number",
                got=f"at {t_us} us",
                do="train it again with a lower learning rate",
            )
        parts = np.maximum(rgb, 0).reshape(height, subpixels, width, subpixels, -1)
        return parts.mean((1, 3), dtype=np.float32)  # [h, w, c]

    return light_at


def stated_sensor(capture: Capture) -> EventSensor:
    """Ideal pixels with the thresholds, refractory time and colour filter that a capture states."""
    known = capture.known
    stated = {"refractory_us": known.refractory_us, "floor": known.log_floor}
    if known.thresholds is not None:
        stated |= {"threshold_off": known.thresholds.negative}
        stated |= {"threshold_on": known.thresholds.positive}
    stated = {name: value for name, value in stated.items() if value is not None}
    return replace(
        EventSensor(), **stated, refractory_rule="reset", bayer=colour_filter_of(capture)
    )


def colour_filter_of(capture: Capture) -> str:
    """The colour filter tile of a capture's event camera; "" for a monochrome one."""
    events = capture.events if capture.events is not None else capture.test_events
    if events is None:
        return ""
    return events.bayer or (BEHIND_FILTERS if events.coloured else "")


def resized_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """A camera with another resolution: scaled, and cropped at the centre to the new shape."""
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
    renderer = renderer_of(model)
    if not isinstance(renderer, ViewRenderer) or camera == model.capture.camera:
        return renderer
    if isinstance(renderer, OtherCameras):
        return renderer.through(camera)
    raise OptionError(
        "this model renders views with the camera of its capture only",
        got=f"{camera.width}x{camera.height}",
        do="leave the size as it was recorded",
    )
