"""When frames were exposed, on the clock of the events.

Two cameras each have a clock. Where the one that takes frames tells the other when its shutter
opens and closes, by a wire, *triggers* say it exactly. Otherwise the *offset* of one clock to the
other is found by what both see: images change most from one to the next when most events happen.
That works where motion is uneven, and says nothing where it is steady, so the result comes with
its certainty.
"""

from dataclasses import dataclass, replace
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numba import njit

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import Exposure
from sharpfield.recordings.recording import Triggers

FEWEST = 8
"""Pairs of frames from which anything is concluded."""
HALF = 0.5
"""At least this share of the frames must have been taken while events were."""
LEAST = 0.5
"""Correlation below which an offset is not believed."""
SIGMAS = 3.0
"""By so many standard errors it must beat the next best one."""
MOST = 3000
"""Frames looked at; of longer recordings, those in the middle."""
STEPS = 4
"""Offsets tried within the time of one frame, before the best is looked at more closely."""

Stamp = Literal["open", "middle", "close"]
"""What the single time of a frame means."""


@dataclass(frozen=True)
class Offset:
    """What is to be added to times of frames to have them on the clock of the events."""

    offset_us: int
    correlation: float
    """Of the change of images with the number of events, at this offset."""
    runner_up: float
    """The same of the best offset that does not lie on the same hill."""
    within_us: int
    """Offsets that fit as well, up to chance, lie no farther off."""
    sigmas: float
    """How clearly it beats the next best."""

    @property
    def certain(self) -> bool:
        """Whether to believe it."""
        return self.correlation >= LEAST and self.sigmas >= SIGMAS

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.offset_us / 1000:.1f} ms, give or take {self.within_us / 1000:.1f} ms"
            f" (correlation {self.correlation:.2f}, next best {self.runner_up:.2f},"
            f" {self.sigmas:.1f} sigma apart)"
        )


def with_length(exposure: Exposure, length: str, stamp: Stamp) -> Exposure:
    """Exposures of some length in place of instants; those that have a length keep it.

    Args:
        exposure: As the recording tells.
        length: A share of the time to the next frame, like "0.5", or a time, like "8ms".
        stamp: Whether the single time of a frame is when its shutter opens, is half way, or closes.

    Raises:
        OptionError: The length cannot be read, or exposures would overlap.
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


def triggered(triggers: Triggers, count: int, *, channel: int | None, where: object) -> Exposure:
    """Exposures between a rising edge and the falling one after it.

    Args:
        triggers: Edges, on the clock of the events.
        count: Of the frames; there must be as many pulses.
        channel: Of the edges, where there are several.
        where: The recording, for messages.

    Raises:
        CaptureError: There are several channels and none is named, or not one pulse a frame.
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
    per_ms: Int64[np.ndarray, "k"],
    origin_us: int,
) -> Offset:
    """The offset at which images change as much as there are events.

    Args:
        change: How much each image differs from the one before it; one fewer than images.
        middles_us: When each image was exposed, on the frames' clock.
        per_ms: Events in each ms.
        origin_us: Where `per_ms` begins, on the events' clock.

    Raises:
        CaptureError: There are too few frames.
    """
    if len(change) < FEWEST:
        raise CaptureError(
            "too few frames to find the offset between two clocks",
            got=f"{len(middles_us)} frames",
            do="give the offset",
        )
    until = np.concatenate([[0], np.cumsum(per_ms)]).astype(np.float64)
    skipped = max(len(change) - MOST, 0) // 2
    change, middles_us = change[skipped : skipped + MOST], middles_us[skipped : skipped + MOST + 1]
    ms = (middles_us - middles_us[0] + 500) // 1000
    interval = max(int(np.median(np.diff(ms))), 1)
    step = max(interval // STEPS, 1)
    fewest = max(FEWEST, int(HALF * len(change)))
    tried = np.arange(-int(ms[-1]), len(per_ms) + 1, step, dtype=np.int64)
    found = _correlations(ms, change, until, tried, fewest)
    if np.isnan(found).all():
        raise CaptureError(
            "frames and events cannot have been recorded together",
            got=f"frames over {ms[-1] / 1000:.1f} s, events over {len(per_ms) / 1000:.1f} s",
            do="give recordings of the same time",
        )
    filled = np.nan_to_num(found, nan=-1.0)
    far = ~_hill(filled)
    runner_up = float(filled[far].max()) if far.any() else -1.0
    tried = tried[filled.argmax()] + np.arange(-interval, interval + 1)
    filled = np.nan_to_num(_correlations(ms, change, until, tried, fewest), nan=-1.0)
    best = int(filled.argmax())
    error = 1 / np.sqrt(len(change) - 3)  # of Fisher's transform of a correlation
    clear = _fisher(filled)
    good = np.flatnonzero(clear >= clear[best] - error)
    offset_us = round(1000 * (float(tried[best]) + _vertex(filled, best)))
    return Offset(
        offset_us=offset_us + origin_us - int(middles_us[0]),
        correlation=float(filled[best]),
        runner_up=runner_up,
        within_us=1000 * max(int(np.abs(tried[good] - tried[best]).max()), 1),
        sigmas=float((clear[best] - _fisher(np.array(runner_up))) / (error * np.sqrt(2))),
    )


def accepted_offset(offset: Offset, where: object) -> int:
    """The offset in us, if it is certain; 0 if the clocks may as well be the same.

    Raises:
        CaptureError: It is not certain.
    """
    if not offset.certain:
        raise CaptureError(
            "cannot tell how the clocks of frames and events are related",
            where=where,
            got=f"the best offset is {offset}",
            do="give --offset-ms, or --clock same if both were on one clock",
        )
    return 0 if abs(offset.offset_us) <= offset.within_us else offset.offset_us


def shifted(exposure: Exposure, offset_us: int) -> Exposure:
    """The same exposures on another clock."""
    return replace(
        exposure, open_us=exposure.open_us + offset_us, close_us=exposure.close_us + offset_us
    )


def _fisher(correlation: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """A transform of correlations whose errors are alike."""
    return np.asarray(np.arctanh(np.clip(correlation, -0.999999, 0.999999)))


def _hill(values: Float64[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """The stretch around the highest value on which none is less than half of it."""
    best = int(values.argmax())
    low = np.flatnonzero(values < HALF * values[best])
    before, after = low[low < best], low[low > best]
    first = before[-1] + 1 if len(before) else 0
    last = after[0] if len(after) else len(values)
    hill = np.zeros(len(values), bool)
    hill[first:last] = True
    return hill


def _vertex(values: Float64[np.ndarray, "n"], at: int) -> float:
    """Where between its neighbours the peak of a parabola through three values lies."""
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
    """The shortest time from one frame to the next."""
    gaps = np.diff(exposure.open_us)
    return int(gaps.min()) if len(gaps) else 0


@njit(cache=True, nogil=True)
@no_type_check
def _correlations(ms, change, until, tried, fewest):
    """Correlation of changes with counts between frames at each offset in ms; nan if too few."""
    found = np.full(tried.size, np.nan)
    for i in range(tried.size):
        n, a, b, aa, bb, ab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(change.size):
            begin, end = ms[k] + tried[i], ms[k + 1] + tried[i]
            if begin < 0 or end >= until.size:
                continue
            count, seen = until[end] - until[begin], change[k]
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
