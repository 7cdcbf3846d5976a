"""How far each pixel is on its way from one event to the next.

An event says that a whole threshold is behind; at any other time the log light of a pixel is
somewhere between its last event and its next one. Where both have the same sign, the light has
been moving one way, and the share of the time between them tells the share of the threshold: the
*phase*. Where they differ the light turned around at a height nobody knows, less than a threshold
beyond the last event. If every height is as likely and the light turns as a thrown stone does, it
spent the time a third of a threshold beyond, on average, and only at last fell to the next event.
Left out, this *overshoot* is what makes counts of events too few after a turn, and thresholds
that explain them too large.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from sharpfield.ops.event_index import EventIndex

LONGEST_US = 20_000
"""Between two events farther apart than this the light may have stood still for a while."""

OVERSHOOT = 1 / 3
"""Mean height beyond the last event until the light turns back: half of a threshold at the top,
two thirds of that over the time. Half as much before another event of the same sign."""

FALL_US, FALL_SHARE = 4_000, 0.4
"""The light falls to its next event within this time, or this share of the time between the two."""


def phase_at(
    index: EventIndex, time_us: int, *, width: int, height: int
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """The signed part of an event that each pixel saw since its last one, and where it is known.

    Args:
        index: Of a mono sensor whose events name pixels, so that its sites are the pixels.
        time_us: By the clock of the events.
        width: Of the sensor.
        height: Of the sensor.

    Returns:
        -1...1, what is likely where it is not known; and whether it is known.
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
        first, low, high = offset[site], offset[site], offset[site + 1]
        while low < high:
            middle = (low + high) // 2
            if t_us[middle] <= time_us:
                low = middle + 1
            else:
                high = middle
        if low == first:
            continue
        if low == offset[site + 1]:
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
