"""Exposure times of frames on the clock of the events.

Two cameras have two clocks. Where the frame camera signals the opening and closing of its shutter
to the event camera by wire, *triggers* give the exposures exactly. Otherwise the *offset* between
the clocks is estimated from what both cameras see: images change most from one to the next when
most events occur. This needs uneven motion and fails with steady motion, so the estimate comes with
its significance.
"""

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numba import njit

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import Exposure
from sharpfield.preparation.ingest.options import Stamp
from sharpfield.recordings.recording import Triggers

MIN_PAIRS = 8
"""Fewest pairs of consecutive frames for an estimate."""
MIN_OVERLAP = 0.5
"""Share of the frame pairs that must lie within the time of the events."""
MIN_CORRELATION = 0.5
"""An offset with a lower correlation is rejected."""
MIN_SIGMAS = 3.0
"""Standard errors by which the best offset must exceed the second best."""
MAX_PAIRS = 3000
"""Frame pairs used; of longer recordings, those in the middle."""
STEPS = 4
"""Offsets tried per frame interval in the coarse search."""


@dataclass(frozen=True)
class ClockOffset:
    """Estimated offset to add to frame times to convert them to the clock of the events."""

    offset_us: int
    correlation: float
    """Correlation between the change of images and the number of events, at this offset."""
    runner_up: float
    """Correlation of the best offset outside the same peak."""
    uncertainty_us: int
    """Offsets that are not significantly worse differ by no more than this."""
    sigmas: float
    """Difference to the second best offset, in standard errors."""

    @property
    def certain(self) -> bool:
        """Whether the offset is significant."""
        return self.correlation >= MIN_CORRELATION and self.sigmas >= MIN_SIGMAS

    def __str__(self) -> str:
        """The offset with its uncertainty, in words."""
        return (
            f"{self.offset_us / 1000:.1f} ms, give or take {self.uncertainty_us / 1000:.1f} ms"
            f" (correlation {self.correlation:.2f}, next best {self.runner_up:.2f},"
            f" {self.sigmas:.1f} sigma apart)"
        )


def with_exposure(exposure: Exposure, length: str, stamp: Stamp) -> Exposure:
    """Give frames with a single time an exposure; frames that have an exposure keep it.

    Args:
        exposure: Exposures as recorded.
        length: Exposure as a share of the frame interval, like "0.5", or as a time, like "8ms".
        stamp: Whether the single time is the opening, the middle or the closing of the shutter.

    Raises:
        OptionError: The length cannot be parsed, or exposures would overlap.
    """
    length_us = _length_us(length, exposure)
    before = {"open": 0, "middle": length_us // 2, "close": length_us}[stamp]
    opens = np.where(exposure.instant, exposure.open_us - before, exposure.open_us)
    closes = np.where(exposure.instant, opens + length_us, exposure.close_us)
    if (opens[1:] < closes[:-1]).any():
        raise OptionError(
            "exposures would overlap",
            got=f"{length_us} us each, {_interval_us(exposure)} us apart",
            do="give a shorter exposure",
        )
    return Exposure(opens, closes)


def exposures_from_triggers(
    triggers: Triggers, count: int, *, channel: int | None, where: object
) -> Exposure:
    """Exposures from trigger pulses, each from a rising to the next falling edge.

    Args:
        triggers: Edges, on the clock of the events.
        count: Number of frames; there must be as many pulses.
        channel: Trigger channel, where there are several.
        where: The recording, for messages.

    Raises:
        CaptureError: There are several channels and none was chosen, or not one pulse per frame.
    """
    channels = np.unique(triggers.channel)
    if channel is None and len(channels) > 1:
        raise CaptureError(
            "triggers came on several channels",
            where=where,
            got=", ".join(map(str, channels)),
            do="name the one that the frame camera drives",
        )
    chosen = triggers.channel == (channels[:1] if channel is None else channel)
    t_us, edge = triggers.t_us[chosen], triggers.edge[chosen]
    first = np.flatnonzero(edge > 0)
    t_us, edge = (
        t_us[first[0] if len(first) else len(t_us) :],
        edge[first[0] if len(first) else 0 :],
    )
    pulses = len(t_us) // 2
    alternate = (edge[: 2 * pulses : 2] > 0).all() and (edge[1 : 2 * pulses : 2] < 0).all()
    if pulses != count or not alternate:
        raise CaptureError(
            "there must be one pulse on the trigger for each frame",
            where=where,
            got=f"{pulses} pulses{'' if alternate else ' with edges missing'}, {count} frames",
            do="crop one of the recordings, or use --clock find, or give --offset-ms",
        )
    return Exposure(t_us[0 : 2 * pulses : 2], t_us[1 : 2 * pulses : 2])


def find_offset(
    change: Float64[np.ndarray, "n"],
    middles_us: Int64[np.ndarray, "m"],
    events_per_ms: Int64[np.ndarray, "k"],
    origin_us: int,
) -> ClockOffset:
    """Find the offset with the highest correlation between image change and event count.

    Args:
        change: Difference of each image to the previous one; one entry fewer than images.
        middles_us: Middle of each exposure, on the clock of the frames.
        events_per_ms: Number of events in each ms.
        origin_us: Begin of `events_per_ms`, on the clock of the events.

    Raises:
        CaptureError: There are too few frames.
    """
    if len(change) < MIN_PAIRS:
        raise CaptureError(
            "too few frames to find the offset between two clocks",
            got=f"{len(middles_us)} frames",
            do="give the offset",
        )
    cumulative = np.concatenate([[0], np.cumsum(events_per_ms)]).astype(np.float64)
    skipped = max(len(change) - MAX_PAIRS, 0) // 2
    change, middles_us = (
        change[skipped : skipped + MAX_PAIRS],
        middles_us[skipped : skipped + MAX_PAIRS + 1],
    )
    ms = (middles_us - middles_us[0] + 500) // 1000
    interval = max(int(np.median(np.diff(ms))), 1)
    step = max(interval // STEPS, 1)
    fewest = max(MIN_PAIRS, int(MIN_OVERLAP * len(change)))
    offsets_ms = np.arange(-int(ms[-1]), len(events_per_ms) + 1, step, dtype=np.int64)
    found = _correlations(ms, change, cumulative, offsets_ms, fewest)
    if np.isnan(found).all():
        raise CaptureError(
            "frames and events cannot have been recorded together",
            got=f"frames over {ms[-1] / 1000:.1f} s, events over {len(events_per_ms) / 1000:.1f} s",
            do="give recordings of the same time",
        )
    filled = np.nan_to_num(found, nan=-1.0)
    far = ~_peak_region(filled)
    runner_up = float(filled[far].max()) if far.any() else -1.0
    offsets_ms = offsets_ms[filled.argmax()] + np.arange(-interval, interval + 1)
    filled = np.nan_to_num(_correlations(ms, change, cumulative, offsets_ms, fewest), nan=-1.0)
    best = int(filled.argmax())
    error = 1 / np.sqrt(len(change) - 3)  # standard error of Fisher's transform of a correlation
    clear = _fisher(filled)
    good = np.flatnonzero(clear >= clear[best] - error)
    offset_us = round(1000 * (float(offsets_ms[best]) + _parabola_peak(filled, best)))
    return ClockOffset(
        offset_us=offset_us + origin_us - int(middles_us[0]),
        correlation=float(filled[best]),
        runner_up=runner_up,
        uncertainty_us=1000 * max(int(np.abs(offsets_ms[good] - offsets_ms[best]).max()), 1),
        sigmas=float((clear[best] - _fisher(np.array(runner_up))) / (error * np.sqrt(2))),
    )


def accepted_offset(offset: ClockOffset, where: object) -> int:
    """The offset in us if it is significant; 0 if it does not differ from 0.

    Raises:
        CaptureError: The offset is not significant.
    """
    if not offset.certain:
        raise CaptureError(
            "cannot tell how the clocks of frames and events are related",
            where=where,
            got=f"the best offset is {offset}",
            do="give --offset-ms, or --clock same if both were on one clock",
        )
    return 0 if abs(offset.offset_us) <= offset.uncertainty_us else offset.offset_us


def shifted(exposure: Exposure, offset_us: int) -> Exposure:
    """Exposures with an offset added to their times."""
    return replace(
        exposure, open_us=exposure.open_us + offset_us, close_us=exposure.close_us + offset_us
    )


def _fisher(correlation: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Fisher's transform, which makes the standard error of a correlation constant."""
    return np.asarray(np.arctanh(np.clip(correlation, -0.999999, 0.999999)))


def _peak_region(values: Float64[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Mask of the interval around the maximum on which values are at least half of it."""
    best = int(values.argmax())
    low = np.flatnonzero(values < 0.5 * values[best])
    before, after = low[low < best], low[low > best]
    first = before[-1] + 1 if len(before) else 0
    last = after[0] if len(after) else len(values)
    region = np.zeros(len(values), bool)
    region[first:last] = True
    return region


def _parabola_peak(values: Float64[np.ndarray, "n"], at: int) -> float:
    """Subsample position of a peak relative to its index, from a parabola through 3 values."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, peak, after = values[at - 1 : at + 2]
    bend = before - 2 * peak + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0


def _length_us(length: str, exposure: Exposure) -> int:
    for ending, factor in (
        ("us", 1.0),
        ("ms", 1e3),
        ("s", 1e6),
        ("", float(_interval_us(exposure))),
    ):
        if length.endswith(ending):
            try:
                value = float(length.removesuffix(ending))
            except ValueError:
                break
            if 0 < value < float("inf") and (ending or value <= 1):
                return round(value * factor)
            break
    raise OptionError(
        "cannot read the exposure", got=length, do="give a share of the interval, 0.5, or 8ms"
    )


def _interval_us(exposure: Exposure) -> int:
    """Shortest frame interval."""
    gaps = np.diff(exposure.open_us)
    return int(gaps.min()) if len(gaps) else 0


@njit(cache=True, nogil=True)
@no_type_check
def _correlations(ms, change, cumulative, offsets_ms, fewest):
    """Correlation of image change and event count at each offset; nan without enough pairs."""
    found = np.full(offsets_ms.size, np.nan)
    for i in range(offsets_ms.size):
        n, a, b, aa, bb, ab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(change.size):
            begin, end = ms[k] + offsets_ms[i], ms[k + 1] + offsets_ms[i]
            if begin < 0 or end >= cumulative.size:
                continue
            count, seen = cumulative[end] - cumulative[begin], change[k]
            n += 1
            a += seen
            b += count
            aa += seen * seen
            bb += count * count
            ab += seen * count
        if n < fewest:
            continue
        spread = (n * aa - a * a) * (n * bb - b * b)
        found[i] = (n * ab - a * b) / np.sqrt(spread) if spread > 0 else 0.0
    return found
