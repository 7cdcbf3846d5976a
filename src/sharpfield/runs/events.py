"""The events that a camera would report in a trained scene, seen by its digital twin."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.errors import expect_one_of
from sharpfield.core.events import EventStream
from sharpfield.runs.views import as_pose
from sharpfield.simulation.sensors.event_pixels import SENSORS, EventSensor
from sharpfield.twin.event_twin import (
    EventTwin,
    TimeSteps,
    Viewpoint,
    colour_filter_of,
    light_of,
    path_viewpoint,
    resized_camera,
    stated_sensor,
    track_viewpoint,
)
from sharpfield.twin.options import RECORDED

TimedPoses = tuple[Sequence[int], Sequence[Any]]
"""Times in us on the capture's clock, and a pose at each."""


def event_sensor(capture: Capture, name: str, threshold: float | None = None) -> EventSensor:
    """A sensor by its name, behind the capture's colour filter.

    Args:
        capture: That the model was trained on.
        name: `recorded`, or one of `SENSORS`.
        threshold: Contrast threshold of both signs, natural log, instead of the sensor's own.

    Raises:
        OptionError: There is no sensor of this name.
    """
    expect_one_of("sensor", name, [RECORDED, *SENSORS])
    if name == RECORDED:
        sensor = stated_sensor(capture)
    else:
        sensor = replace(SENSORS[name], bayer=colour_filter_of(capture))
    if threshold is None:
        return sensor
    return replace(sensor, threshold_on=threshold, threshold_off=threshold)


def whole_steps(span_us: tuple[int, int], last_us: int, time_steps: TimeSteps) -> tuple[int, int]:
    """A span with all of its last step, so that where it is cut changes nothing before."""
    start, end = span_us
    steps = -(-(end - start) // time_steps.step_us)
    return start, min(start + steps * time_steps.step_us, last_us)


def event_viewpoint(
    model: Any, capture: Capture, path: int | TimedPoses, size: tuple[int, int] | None
) -> Viewpoint:
    """An event camera on a track of the capture, or on a path of its own."""
    if isinstance(path, int):
        seen = track_viewpoint(model, capture, path)
    else:
        times_us, poses = path
        seen = path_viewpoint(
            model, np.asarray(times_us, np.int64), np.stack([as_pose(pose) for pose in poses])
        )
    return seen if size is None else replace(seen, camera=resized_camera(seen.camera, size))


def render_events(
    model: Any,
    seen: Viewpoint,
    sensor: EventSensor,
    span_us: tuple[float | int | None, float | int | None],
    *,
    time_steps: TimeSteps,
    subpixels: int = 1,
    seed: int = 0,
) -> EventStream:
    """All events of a camera between two times, None for where its path begins and ends.

    Raises:
        OptionError: The span is empty, or not within the camera's path.
    """
    first, last = seen.span_us
    start, end = (None if us is None else round(us) - first for us in span_us)
    part = seen.between(start, end)
    light = light_of(model, part, subpixels=subpixels)
    twin = EventTwin(
        light, whole_steps(part.span_us, last, time_steps), sensor, time_steps=time_steps, seed=seed
    )
    return twin.until(part.span_us[1])
