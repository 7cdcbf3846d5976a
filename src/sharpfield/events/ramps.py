"""Log light of a pixel between two of its events: the fraction of a threshold since the last one.

At an event the log light of a pixel has changed by a whole threshold since the one before; at any
other time it lies in between. The *phase* is the signed fraction of a threshold since the last
event.

- Two events of the same sign: the light changed in one direction, and the phase is taken as linear
  in time.
- Two events of opposite signs: the light turned around at an unknown level, less than one threshold
  beyond the first event. If all levels are equally likely and the light turns along a parabola, it
  was a third of a threshold beyond the first event, on average over that time, and fell to the
  second event only shortly before it. Without this *overshoot*, counts of events after a turn are
  too small, and thresholds fitted to them too large.

Counted events form a staircase, which rises only when a whole threshold has been passed: it is late
by about a millisecond, and so are images made from it. The piecewise-linear light used here
instead has a *ramp* before each event: the light changes in the last part of the time before it.
"""

import math
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from sharpfield.events.index import EventIndex, first_since

LONGEST_US = 20_000
"""Between two events farther apart than this the light may have been constant for a while."""

OVERSHOOT = 1 / 3
"""Mean level beyond the last event while the light turns back, in thresholds: 1/2 is the expected
peak, and a parabola's mean is 2/3 of its peak. Half as much before an event of the same sign."""

FALL_US, FALL_SHARE = 4_000, 0.4
"""The light falls to its next event within this time, or this fraction of the time between them."""


def phase_at(
    index: EventIndex, time_us: int, *, width: int, height: int
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """The phase of each pixel at a time, and where it is known.

    Args:
        index: Of a mono sensor whose events name pixels, so that its sites are the pixels.
        time_us: By the clock of the events.
        width: Of the sensor.
        height: Of the sensor.

    Returns:
        The phase, -1...1, with its expected value where it is not known; and whether it is known,
        which it is between two close events of the same sign.
    """
    assert index.sites == width * height, "sites are the pixels of the sensor"
    phase = np.zeros(index.sites, np.float32)
    known = np.zeros(index.sites, np.bool_)
    _phases(index.offset, index.t_us, index.p, time_us, phase, known)
    shape = height, width
    return torch.as_tensor(phase.reshape(shape)), torch.as_tensor(known.reshape(shape))


@njit(cache=True, nogil=True)
@no_type_check
def _phases(offset, t_us, p, time_us, phase, known):
    for site in range(len(phase)):
        first, last = offset[site], offset[site + 1]
        low = first_since(t_us, first, last, time_us + 1)
        if low == first:
            continue
        if low == last:
            phase[site] = OVERSHOOT * p[low - 1]
            continue
        gap, since, same = t_us[low] - t_us[low - 1], time_us - t_us[low - 1], p[low] == p[low - 1]
        if same and gap <= LONGEST_US:
            known[site] = True
            phase[site] = p[low] * since / max(gap, 1)
            continue
        beyond = OVERSHOOT * p[low - 1] * (0.5 if same else 1.0)
        fall = min(FALL_US, FALL_SHARE * gap)
        fallen = min(max(1 - (gap - since) / fall, 0.0), 1.0) if fall > 0 else 0.0
        phase[site] = (1 - fallen) * beyond + fallen * p[low]


RAMP_US = 7_000
"""Longest ramp; before it the light is taken as constant. 5 to 10 ms are best for a hand-held
camera."""


def ramp_at(index: EventIndex, time_us: int, size: tuple[int, int]) -> Float[Tensor, "h w 2"]:
    """The phase at a time, apart by sign: to darker (-1...0) and to brighter (0...1).

    Args:
        index: Of a mono sensor whose events name pixels.
        time_us: By the clock of the events.
        size: Width and height.
    """
    parts = np.zeros((index.sites, 2), np.float32)
    _ramps(index.offset, index.t_us, index.p, time_us, parts)
    return torch.as_tensor(parts.reshape(size[1], size[0], 2))


def ramped_log_mean(
    index: EventIndex,
    window_us: tuple[int, int],
    thresholds: tuple[float, float],
    size: tuple[int, int],
) -> Float[Tensor, "h w 1"]:
    """Log of the time average of exp(change since the opening) over one exposure.

    Args:
        index: Of a mono sensor whose events name pixels.
        window_us: Opening and closing of the shutter, by the clock of the events.
        thresholds: To darker and to brighter.
        size: Width and height.
    """
    mean = np.zeros(index.sites)
    if window_us[1] > window_us[0]:
        _log_means(index.offset, index.t_us, index.p, window_us, thresholds, mean)
    return torch.as_tensor(mean.reshape(size[1], size[0], 1), dtype=torch.float32)


@njit(cache=True, nogil=True)
@no_type_check
def _begin(t_us, first, event):
    """When the ramp to an event begins."""
    begin = t_us[event] - RAMP_US
    return max(begin, t_us[event - 1]) if event > first else begin


@njit(cache=True, nogil=True)
@no_type_check
def _beyond(t_us, p, first, event, last):
    """Signed level beyond the event before this one, until the ramp begins, in thresholds."""
    if event == first:
        return 0.0
    height = OVERSHOOT * p[event - 1]
    if event == last or p[event] != p[event - 1]:
        return height
    return 0.5 * height if t_us[event] - t_us[event - 1] > LONGEST_US else 0.0


@njit(cache=True, nogil=True)
@no_type_check
def _ramps(offset, t_us, p, time_us, parts):
    for site in range(len(parts)):
        first, last = offset[site], offset[site + 1]
        event = first_since(t_us, first, last, time_us + 1)
        risen = 0.0
        if event < last:
            begin = _begin(t_us, first, event)
            if time_us > begin:
                risen = (time_us - begin) / (t_us[event] - begin)
                parts[site, 1 if p[event] > 0 else 0] = risen * p[event]
        beyond = _beyond(t_us, p, first, event, last)
        parts[site, 1 if beyond > 0 else 0] += (1 - risen) * beyond


@njit(cache=True, nogil=True)
@no_type_check
def _area(level, begin, end, slope_from, step, ramp):
    """Integral of exp(level + ramp) from one time to another; the ramp starts at `slope_from`."""
    flat_end = min(max(slope_from, begin), end)
    area = math.exp(level) * (flat_end - begin)
    if end > flat_end:
        low = level + step * (flat_end - slope_from) / ramp
        high = level + step * (end - slope_from) / ramp
        if abs(high - low) < 1e-6:
            area += math.exp(low) * (end - flat_end)
        else:
            area += (math.exp(high) - math.exp(low)) / (high - low) * (end - flat_end)
    return area


@njit(cache=True, nogil=True)
@no_type_check
def _log_means(offset, t_us, p, window_us, thresholds, mean):
    opens, closes = window_us
    for site in range(len(mean)):
        first, last = offset[site], offset[site + 1]
        event = first_since(t_us, first, last, opens + 1)
        now, level, area, started = opens, 0.0, 0.0, False
        while now < closes:
            end, slope_from, step, ramp = closes, closes, 0.0, 1.0
            beyond = _beyond(t_us, p, first, event, last)
            beyond *= thresholds[1] if beyond > 0 else thresholds[0]
            if event < last:
                slope_from = _begin(t_us, first, event)
                step = thresholds[1] if p[event] > 0 else -thresholds[0]
                ramp = max(t_us[event] - slope_from, 1)
                end = min(closes, t_us[event])
            if not started:
                # Relative to the opening, which may be on a ramp.
                level = -beyond - (step - beyond) * max(opens - slope_from, 0) / ramp
                started = True
            area += _area(level + beyond, now, end, slope_from, step - beyond, ramp)
            level += step
            now = end
            event += 1
        mean[site] = math.log(area / (closes - opens))
