"""How well rendered events agree with recorded ones.

    count       number of events, predicted over recorded
    pixel       numbers of events at each pixel in a window
    sign        sign of the summed polarities at a pixel in a window: darker, brighter, or none
    timing      time from a recorded event to the nearest predicted one of its pixel and polarity

The PSNR of event frames has a fixed peak in counts. The published one has a peak of twice the
largest count of the whole set, which gives predicting no events at all a high score.

Thresholds at which the rendered camera reports as many events as were recorded.

A trained scene lacks fine texture and sharp edges, so its light changes less and a camera in front
of it reports too few events. Lower thresholds restore the number of events. They cannot correct
where and when events happen; the factors on the thresholds measure how soft the scene is.

    window    a time window of the recording in which events are counted
    lead      the time before a window, simulated but not counted, in which each pixel comes to the
              reference level of its own last event
    factor    on the threshold of each polarity; the same for any sensor

Source: our own. EDI (Pan et al., CVPR 2019) and Robust e-NeRF (Low and Lee, ICCV 2023) also take
thresholds from data, as part of the reconstruction.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.metrics.image import relative_count_error
from sharpfield.report.colormaps import colour_signs, side_by_side
from sharpfield.report.event_frames import count_events, full_count, signed
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.events import EventPixels
from sharpfield.twin.event_twin import (
    TIME_STEPS,
    TimeSteps,
    Viewpoint,
    images,
    light_of,
    stated_sensor,
    track_viewpoint,
)

MOST_COUNT = 20
"""Counts of a pixel and window are clipped to this before they are compared as images."""


@dataclass(frozen=True)
class EventAgreement:
    """Metrics of one comparison; NaN where there was nothing to compare."""

    predicted: int
    """Number of events."""
    recorded: int
    """Number of events."""
    count_ratio: float
    """Predicted over recorded."""
    pixel_correlation: float
    """Of the event counts of each pixel and polarity over the whole time."""
    count_error: float
    """Sum of absolute count errors over all windows, relative to all recorded events; 1 for
    predicting none."""
    sign_iou: float
    """Pixels and windows of the same sign over those where either stream has events."""
    frame_psnr: float
    """Of signed event frames, in dB, with a range of plus and minus `MOST_COUNT` events."""
    empty_psnr: float
    """`frame_psnr` of predicting no events at all."""
    timing_ms: float
    """Median time from a recorded event to the nearest predicted one of its pixel and polarity."""
    timed_share: float
    """Share of recorded events that have such a predicted event."""


def compare_events(
    predicted: EventStream, recorded: EventStream, edges_us: Sequence[int]
) -> EventAgreement:
    """Compare two streams; only events within `edges_us`, the boundaries of the windows, count.

    Raises:
        OptionError: The sensors differ in size, or nothing was recorded.
    """
    predicted, recorded = (s.window(edges_us[0], edges_us[-1]) for s in (predicted, recorded))
    sizes = [(s.width, s.height) for s in (predicted, recorded)]
    if sizes[0] != sizes[1]:
        raise OptionError("the two sensors differ in size", got=f"{sizes[0]} and {sizes[1]} px")
    if not len(recorded):
        raise OptionError("nothing was recorded in this time, by this camera")
    counts = [_counts(stream, edges_us) for stream in (predicted, recorded)]
    total = [part.sum(0).ravel().astype(np.float64) for part in counts]  # [h * w * 2]
    frames = [signed(part) for part in counts]  # [n, h, w]
    offset_us = _nearest_us(predicted, recorded, edges_us[0])
    found = offset_us >= 0
    either = (frames[0] != 0) | (frames[1] != 0)
    same = either & (np.sign(frames[0]) == np.sign(frames[1]))
    varied = all(part.std() > 0 for part in total)
    return EventAgreement(
        predicted=len(predicted),
        recorded=len(recorded),
        count_ratio=len(predicted) / len(recorded),
        pixel_correlation=float(np.corrcoef(*total)[0, 1]) if varied else math.nan,
        count_error=float(relative_count_error(*(torch.from_numpy(c).float() for c in counts))),
        sign_iou=float(same.sum() / either.sum()) if either.any() else math.nan,
        frame_psnr=_psnr(frames[0], frames[1]),
        empty_psnr=_psnr(np.zeros_like(frames[1]), frames[1]),
        timing_ms=float(np.median(offset_us[found])) / 1000 if found.any() else math.nan,
        timed_share=float(found.mean()),
    )


def busiest_window(
    predicted: EventStream, recorded: EventStream, edges_us: Sequence[int]
) -> UInt8[np.ndarray, "height width 3"]:
    """Event frames of the window with the most events: recorded left, predicted right."""
    starts = np.searchsorted(recorded.t_us, edges_us)
    chosen = int(np.argmax(np.diff(starts)))
    window = edges_us[chosen], edges_us[chosen + 1]
    frames = [signed(count_events(part.window(*window))) for part in (recorded, predicted)]
    full = full_count(frames[0])
    return side_by_side(*(colour_signs(frame, full) for frame in frames))


def _counts(events: EventStream, edges_us: Sequence[int]) -> Int32[np.ndarray, "n h w 2"]:
    pairs = zip(edges_us[:-1], edges_us[1:], strict=True)
    return np.stack([count_events(events.window(*pair)) for pair in pairs])


def _psnr(a: Int32[np.ndarray, "n h w"], b: Int32[np.ndarray, "n h w"]) -> float:
    a, b = (np.clip(part, -MOST_COUNT, MOST_COUNT).astype(np.float64) for part in (a, b))
    error = float(np.square(a - b).mean())
    return 10 * math.log10((2 * MOST_COUNT) ** 2 / error) if error else math.inf


def _nearest_us(
    predicted: EventStream, recorded: EventStream, start_us: int
) -> Float[np.ndarray, "n"]:
    """Time from each recorded event to the nearest predicted one of its pixel and polarity.

    -1 where there is none.
    """
    if not len(predicted):
        return np.full(len(recorded), -1.0)
    span = 1 + max(int(predicted.t_us[-1]), int(recorded.t_us[-1])) - start_us
    candidates, wanted = (_keys(stream, start_us, span) for stream in (predicted, recorded))
    candidates.sort()
    at = np.searchsorted(candidates, wanted)
    nearest = np.full(len(wanted), np.inf)
    for i in (np.maximum(at - 1, 0), np.minimum(at, len(candidates) - 1)):  # before, after
        same = candidates[i] // span == wanted // span
        apart = np.abs(candidates[i] - wanted).astype(np.float64)
        nearest = np.minimum(nearest, np.where(same, apart, np.inf))
    return np.where(np.isfinite(nearest), nearest, -1.0)


def _keys(events: EventStream, start_us: int, span: int) -> Int64[np.ndarray, "n"]:
    """A sort key of each event: pixel, then polarity, then time."""
    x, y = (
        np.clip(np.floor(np.asarray(position, np.float64) + 0.5), 0, size - 1).astype(np.int64)
        for position, size in ((events.x, events.width), (events.y, events.height))
    )
    return ((y * events.width + x) * 2 + (events.p > 0)) * span + (events.t_us - start_us)


ROUNDS = 12
"""Most iterations of the search."""
TOLERANCE = 0.005
"""The search ends when the counts of both polarities are within this share."""
EXPONENT = 0.7
"""A threshold is multiplied by this power of the ratio of counts: counts grow faster than
thresholds fall, since weaker edges begin to cross them."""
LARGEST_FACTOR = 4.0
"""Largest factor on a threshold, and the inverse of the smallest."""

TimedImages = list[tuple[int, Float32[np.ndarray, "h w"]]]
"""Times in us and light images of a lead and its window."""


@dataclass(frozen=True)
class MatchOptions:
    """Which part of the recording is compared."""

    windows: int = 6
    """Number of windows, spread evenly over the recording and over its cameras."""
    window_us: int = 24_000
    """Length of a window."""
    lead_us: int = 24_000
    """Time simulated before each window without counting its events."""

    def __post_init__(self) -> None:
        if self.windows < 1 or self.window_us < 1 or self.lead_us < 0:
            raise OptionError(
                "matching needs at least one window of a positive length",
                got=f"{self.windows} of {self.window_us} us, after {self.lead_us} us",
            )


MATCH_OPTIONS = MatchOptions()


@dataclass(frozen=True)
class ThresholdFactors:
    """Factors on the thresholds of both polarities."""

    on: float
    """Factor on the threshold of events to brighter."""
    off: float
    """Factor on the threshold of events to darker."""
    recorded: int
    """Recorded events in all windows."""
    unmatched: int
    """Rendered events in the same windows, at the thresholds that the capture states."""

    def applied(self, sensor: EventSensor) -> EventSensor:
        """A sensor with its thresholds multiplied by the factors."""
        return _scaled(sensor, self.off, self.on)


def match_thresholds(
    model: Any,
    capture: Capture,
    *,
    options: MatchOptions = MATCH_OPTIONS,
    away_from: tuple[int, int] | None = None,
    subpixels: int = 1,
    time_steps: TimeSteps = TIME_STEPS,
) -> ThresholdFactors:
    """Find thresholds for which a model gives as many events as its training capture recorded.

    Args:
        model: Trained.
        capture: What it was trained on, as read.
        options: Which part of the recording is compared.
        away_from: A time span in us that no window overlaps: the one to be predicted.
        subpixels: See `light_of`.
        time_steps: Time steps of the simulated sensor.

    Raises:
        OptionError: There are no events to match, or the scene gives far too few or too many.
    """
    sensor = stated_sensor(capture)
    stream = capture.events
    if stream is None or not len(stream):
        raise OptionError("the capture has no events to match thresholds to", where=capture.name)
    rendered: list[tuple[int, TimedImages]] = []
    recorded = np.zeros(2, np.int64)
    for view, start_us in _windows(model, capture, stream, options, away_from):
        light = light_of(model, view, subpixels=subpixels)
        rendered.append((start_us, list(images(light, view.span_us, sensor, time_steps))))
        recorded += _by_polarity(stream.of_track(view.track).window(start_us, view.span_us[1]).p)
    if not recorded.all():
        raise OptionError(
            "too little was recorded to match thresholds to",
            where=capture.name,
            got=f"{recorded[0]} events to darker, {recorded[1]} to brighter, in all windows",
        )
    factor, unmatched = _fit(rendered, sensor, recorded)
    return ThresholdFactors(float(factor[1]), float(factor[0]), int(recorded.sum()), unmatched)


def _windows(
    model: Any,
    capture: Capture,
    stream: EventStream,
    options: MatchOptions,
    away_from: tuple[int, int] | None,
) -> Iterator[tuple[Viewpoint, int]]:
    """The viewpoint during each lead and window, and when the window begins."""
    length_us = options.lead_us + options.window_us
    tracks = np.unique(stream.track).tolist() if stream.track is not None else [0]
    found = 0
    for number, track in zip(range(options.windows), itertools.cycle(tracks), strict=False):
        view = track_viewpoint(model, capture, int(track))
        share = (number + 0.5) / options.windows
        begin = _start_us(view.span_us, length_us, away_from, share)
        if begin is None:
            continue
        found += 1
        end = min(begin + length_us, view.span_us[1])
        yield replace(view, span_us=(begin, end)), min(begin + options.lead_us, end - 1)
    if not found:
        raise OptionError(
            "nothing of the recording is left to match thresholds to",
            where=capture.name,
            do="predict a shorter time span",
        )


def _start_us(
    span_us: tuple[int, int], length_us: int, away_from: tuple[int, int] | None, share: float
) -> int | None:
    """Start of a window at a share 0...1 of all possible starts; None if there are none."""
    first, last = span_us
    if away_from is None:
        return first + round(share * max(last - first - length_us, 0))
    before = min(away_from[0], last) - length_us + 1 - first
    after = last - length_us + 1 - max(away_from[1], first)
    position = int(share * (max(before, 0) + max(after, 0)))
    if before > 0 and position < before:
        return first + position
    return max(away_from[1], first) + position - max(before, 0) if after > 0 else None


def _fit(
    rendered: list[tuple[int, TimedImages]], sensor: EventSensor, recorded: Int64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "2"], int]:
    """Factors on the thresholds (darker, brighter), and the number of events without them."""
    factor, unmatched = np.ones(2), 0
    for number in range(ROUNDS):
        scaled = _scaled(sensor, factor[0], factor[1])
        counts = np.sum([_count(timed, start_us, scaled) for start_us, timed in rendered], 0)
        unmatched = unmatched if number else int(counts.sum())
        ratio = np.maximum(counts, 1) / recorded
        if np.abs(ratio - 1).max() < TOLERANCE:
            break
        factor = factor * ratio**EXPONENT
        if not (1 / LARGEST_FACTOR < factor.min() and factor.max() < LARGEST_FACTOR):
            raise OptionError(
                "the number of rendered events is too far from the recorded one to be matched",
                got=f"{unmatched:,} events where {recorded.sum():,} were recorded",
                do="train it longer, or check the threshold that the capture states",
            )
    return factor, unmatched


def _scaled(sensor: EventSensor, off: float, on: float) -> EventSensor:
    thresholds = {"threshold_on": sensor.threshold_on * on}
    return replace(sensor, **thresholds, threshold_off=sensor.threshold_off * off)


def _count(timed: TimedImages, start_us: int, sensor: EventSensor) -> Int64[np.ndarray, "2"]:
    """Number of events to darker and to brighter since the start of a window."""
    pixels, counts = EventPixels(sensor, 0), np.zeros(2, np.int64)
    for t_us, light in timed:
        gap = pixels.see(light, 1000 * t_us)
        counts += _by_polarity(gap.p[gap.t_us >= start_us])
    return counts


def _by_polarity(p: np.ndarray) -> Int64[np.ndarray, "2"]:
    return np.array([np.count_nonzero(p < 0), np.count_nonzero(p > 0)], np.int64)
