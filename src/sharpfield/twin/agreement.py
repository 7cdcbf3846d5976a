"""How well the events of a twin agree with those that a real camera, or another, recorded.

    count       of all events, predicted over recorded
    pixel       numbers of events at each pixel in a window
    sign        of the sum of signs at a pixel in a window: darker, brighter, or nothing
    timing      from a recorded event to the nearest predicted one of its pixel and sign

The PSNR of event frames has a fixed range in counts, unlike the published one, whose range is
twice the largest count of the whole set: a prediction of no events at all looks good in it.
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
from sharpfield.report.colormaps import colour_signs
from sharpfield.report.event_frames import busy, count_events, signed

MOST_COUNT = 20
"""Larger counts of a pixel and window are cut to this before they are compared as images."""

GAP_PX = 4
"""Between images side by side."""


@dataclass(frozen=True)
class Agreement:
    """Numbers of one comparison; NaN where nothing was there to compare."""

    predicted: int
    """Events."""
    recorded: int
    count_ratio: float
    """Predicted over recorded."""
    pixel_correlation: float
    """Of the number of events at each pixel over the whole time, both signs counted apart."""
    count_error: float
    """Wrong counts in all windows as a share of all recorded events; 1 for predicting none."""
    sign_iou: float
    """Pixels and windows of the same sign over those where either says anything."""
    frame_psnr: float
    """Of signed event frames, in dB, with a range of plus and minus `MOST_COUNT` events."""
    empty_psnr: float
    """The same for predicting no event at all."""
    timing_ms: float
    """Median time from a recorded event to the nearest predicted one of its pixel and sign."""
    timed_share: float
    """Share of recorded events that have one."""


def agreement(predicted: EventStream, recorded: EventStream, edges_us: Sequence[int]) -> Agreement:
    """Compare two streams.

    Args:
        predicted: Of the twin.
        recorded: Of the camera it stands for.
        edges_us: Where windows begin and end; only what lies within counts.

    Raises:
        OptionError: The sensors differ in size, or nothing was recorded.
    """
    mine, theirs = (s.window(edges_us[0], edges_us[-1]) for s in (predicted, recorded))
    sizes = [(s.width, s.height) for s in (mine, theirs)]
    if sizes[0] != sizes[1]:
        raise OptionError("the two sensors differ in size", got=f"{sizes[0]} and {sizes[1]} px")
    if not len(theirs):
        raise OptionError("nothing was recorded in this time, by this camera")
    counts = [_counts(stream, edges_us) for stream in (mine, theirs)]
    total = [part.sum(0).ravel().astype(np.float64) for part in counts]
    frames = [signed(part) for part in counts]
    offset_us = _nearest_us(mine, theirs, edges_us[0])
    found = offset_us >= 0
    either = (frames[0] != 0) | (frames[1] != 0)
    same = either & (np.sign(frames[0]) == np.sign(frames[1]))
    varied = all(part.std() > 0 for part in total)
    return Agreement(
        predicted=len(mine),
        recorded=len(theirs),
        count_ratio=len(mine) / len(theirs),
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


def side_by_side(
    predicted: EventStream, recorded: EventStream, edges_us: Sequence[int]
) -> UInt8[np.ndarray, "height width 3"]:
    """The busiest window: what was recorded on the left, the twin on the right."""
    starts = np.searchsorted(recorded.t_us, edges_us)
    chosen = int(np.argmax(np.diff(starts)))
    window = edges_us[chosen], edges_us[chosen + 1]
    frames = [signed(count_events(part.window(*window))) for part in (recorded, predicted)]
    full = busy(frames[0])
    left, right = (colour_signs(frame, full) for frame in frames)
    gap = np.full((left.shape[0], GAP_PX, 3), 255, np.uint8)
    return np.concatenate([left, gap, right], 1)


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
    """Time from each recorded event to the nearest predicted one of its kind; -1 without one."""
    if not len(predicted):
        return np.full(len(recorded), -1.0)
    span = 1 + max(int(predicted.t_us[-1]), int(recorded.t_us[-1])) - start_us
    here, there = (_keys(stream, start_us, span) for stream in (predicted, recorded))
    here.sort()
    place = np.searchsorted(here, there)
    nearest = np.full(len(there), np.inf)
    for beside in (np.maximum(place - 1, 0), np.minimum(place, len(here) - 1)):
        alike = here[beside] // span == there // span
        away = np.abs(here[beside] - there).astype(np.float64)
        nearest = np.minimum(nearest, np.where(alike, away, np.inf))
    return np.where(np.isfinite(nearest), nearest, -1.0)


def _keys(events: EventStream, start_us: int, span: int) -> Int64[np.ndarray, "n"]:
    """A number for each event that orders by pixel, then sign, then time."""
    x, y = (
        np.clip(np.floor(np.asarray(place, np.float64) + 0.5), 0, size - 1).astype(np.int64)
        for place, size in ((events.x, events.width), (events.y, events.height))
    )
    return ((y * events.width + x) * 2 + (events.p > 0)) * span + (events.t_us - start_us)
