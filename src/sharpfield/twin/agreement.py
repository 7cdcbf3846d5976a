"""How well rendered events agree with recorded ones.

    count       number of events, predicted over recorded
    pixel       numbers of events at each pixel in a window
    sign        sign of the summed polarities at a pixel in a window: darker, brighter, or none
    timing      time from a recorded event to the nearest predicted one of its pixel and polarity

The PSNR of event frames has a fixed peak in counts. The published one has a peak of twice the
largest count of the whole set, which gives predicting no events at all a high score.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64, UInt8

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.metrics.image import relative_count_error
from sharpfield.report.colormaps import colour_signs, side_by_side
from sharpfield.report.event_frames import count_events, full_count, signed

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
    """Compare two streams.

    Args:
        predicted: Rendered events.
        recorded: Events of the real camera.
        edges_us: Boundaries of the windows; only events within them count.

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
        count_error=float(
            relative_count_error(*(torch.from_numpy(part).float() for part in counts))
        ),
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
