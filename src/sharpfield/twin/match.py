"""Thresholds at which a twin reports as many events as its capture's cameras recorded.

What a trained scene leaves out, fine texture and the last sharpness of edges, is light that goes up
and down less: a camera in front of it reports too few events. Lower thresholds bring the number
back. Where and when events happen they cannot mend, and they say how soft the scene is.

    window    a stretch of the recording in which events are counted
    lead      before a window, seen but not counted: pixels come to compare with levels of their own
    factor    on a threshold, for each sign; the same for any sensor that is put in front

Source: our own. EDI (Pan et al., CVPR 2019) and Robust e-NeRF (Low and Lee, ICCV 2023) also take
thresholds from data, as part of the reconstruction.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.events import EventPixels
from sharpfield.twin.twin import (
    PACE,
    Pace,
    Viewpoint,
    images,
    light_of,
    on_track,
    recorded_sensor,
)

ROUNDS = 12
"""Most trials of a pair of thresholds."""
CLOSE = 0.005
"""Counts that differ by this share, of either sign, are taken for equal."""
STEP = 0.7
"""Power of the ratio of counts by which a threshold is changed: counts grow faster than thresholds
fall, for weak edges come in."""
FARTHEST = 4.0
"""Most that a threshold is changed by, either way."""

ViewSampler = list[tuple[int, Float32[np.ndarray, "h w"]]]
"""Images of a lead and its window."""


@dataclass(frozen=True)
class Matching:
    """What is looked at."""

    windows: int = 6
    """Spread evenly over the recording, and over its cameras."""
    window_us: int = 24_000
    lead_us: int = 24_000

    def __post_init__(self) -> None:
        if self.windows < 1 or self.window_us < 1 or self.lead_us < 0:
            raise OptionError(
                "windows to match must be there, and have a length",
                got=f"{self.windows} of {self.window_us} us, after {self.lead_us} us",
            )


MATCHING = Matching()


@dataclass(frozen=True)
class Match:
    """What was found."""

    on: float
    """Factor on the threshold to brighter."""
    off: float
    """Factor on the threshold to darker."""
    recorded: int
    """Events in all windows."""
    unmatched: int
    """Events of the twin in the same windows, at the thresholds that the capture states."""

    def of(self, sensor: EventSensor) -> EventSensor:
        """A sensor with thresholds that fit the scene."""
        return replace(
            sensor,
            threshold_on=sensor.threshold_on * self.on,
            threshold_off=sensor.threshold_off * self.off,
        )


def match(
    model: Any,
    capture: Capture,
    *,
    matching: Matching = MATCHING,
    away_from: tuple[int, int] | None = None,
    subpixels: int = 1,
    pace: Pace = PACE,
) -> Match:
    """Compare a model with the recording that taught it.

    Args:
        model: Trained.
        capture: What it was trained on, as read.
        matching: How much of the recording is looked at.
        away_from: A stretch of time, in us, that no window touches: what is to be predicted.
        subpixels: See `light_of`.
        pace: Steps of time.

    Raises:
        OptionError: There are no events to match, or the scene makes far too few or too many.
    """
    sensor = recorded_sensor(capture)
    stream = capture.events
    if stream is None or not len(stream):
        raise OptionError("the capture has no events to match thresholds to", where=capture.name)
    seen: list[tuple[int, ViewSampler]] = []
    recorded = np.zeros(2, np.int64)
    for seat, start_us in _places(model, capture, stream, matching, away_from):
        draw = light_of(model, seat, subpixels=subpixels)
        seen.append((start_us, list(images(draw, seat.span_us, sensor, pace))))
        recorded += _signs(stream.of_track(seat.track).window(start_us, seat.span_us[1]).p)
    if not recorded.all():
        raise OptionError(
            "too little was recorded to match thresholds to",
            where=capture.name,
            got=f"{recorded[0]} events to darker, {recorded[1]} to brighter, in all windows",
        )
    factor, unmatched = _fit(seen, sensor, recorded)
    return Match(float(factor[1]), float(factor[0]), int(recorded.sum()), unmatched)


def _places(
    model: Any,
    capture: Capture,
    stream: EventStream,
    matching: Matching,
    away_from: tuple[int, int] | None,
) -> Iterator[tuple[Viewpoint, int]]:
    """Where the camera is during each lead and window, and when the window begins."""
    length = matching.lead_us + matching.window_us
    tracks = np.unique(stream.track).tolist() if stream.track is not None else [0]
    found = 0
    for number, track in zip(range(matching.windows), itertools.cycle(tracks), strict=False):
        seat = on_track(model, capture, int(track))
        share = (number + 0.5) / matching.windows
        begin = _start_us(seat.span_us, length, away_from, share)
        if begin is None:
            continue
        found += 1
        end = min(begin + length, seat.span_us[1])
        yield replace(seat, span_us=(begin, end)), min(begin + matching.lead_us, end - 1)
    if not found:
        raise OptionError(
            "nothing of the recording is left to match thresholds to",
            where=capture.name,
            do="predict a shorter stretch of time",
        )


def _start_us(
    span_us: tuple[int, int], length: int, away_from: tuple[int, int] | None, share: float
) -> int | None:
    """Where something of a length may begin, at a share of all places; None if there are none."""
    first, last = span_us
    if away_from is None:
        return first + round(share * max(last - first - length, 0))
    before = min(away_from[0], last) - length + 1 - first
    after = last - length + 1 - max(away_from[1], first)
    place = int(share * (max(before, 0) + max(after, 0)))
    if before > 0 and place < before:
        return first + place
    return max(away_from[1], first) + place - max(before, 0) if after > 0 else None


def _fit(
    seen: list[tuple[int, ViewSampler]], sensor: EventSensor, recorded: Int64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "2"], int]:
    """Factors on both thresholds, darker first; and the number of events without them."""
    factor, unmatched = np.ones(2), 0
    for number in range(ROUNDS):
        scaled = replace(
            sensor,
            threshold_on=sensor.threshold_on * factor[1],
            threshold_off=sensor.threshold_off * factor[0],
        )
        counts = sum((_count(looks, start, scaled) for start, looks in seen), np.zeros(2, np.int64))
        unmatched = unmatched if number else int(counts.sum())
        ratio = np.maximum(counts, 1) / recorded
        if np.abs(ratio - 1).max() < CLOSE:
            break
        factor = factor * ratio**STEP
        if not (1 / FARTHEST < factor.min() and factor.max() < FARTHEST):
            raise OptionError(
                "the scene's events are too far from the recorded ones to be matched",
                got=f"{unmatched:,} events where {recorded.sum():,} were recorded",
                do="train it longer, or check the threshold that the capture states",
            )
    return factor, unmatched


def _count(looks: ViewSampler, start_us: int, sensor: EventSensor) -> Int64[np.ndarray, "2"]:
    """Events to darker and to brighter since the start of a window."""
    pixels, counts = EventPixels(sensor, 0), np.zeros(2, np.int64)
    for t_us, light in looks:
        gap = pixels.see(light, 1000 * t_us)
        counts += _signs(gap.p[gap.t_us >= start_us])
    return counts


def _signs(p: np.ndarray) -> Int64[np.ndarray, "2"]:
    return np.array([np.count_nonzero(p < 0), np.count_nonzero(p > 0)], np.int64)
