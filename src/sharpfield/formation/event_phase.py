"""How far each pixel is on its way from one event to the next.

An event says that a whole threshold is behind; at any other time the log light of a pixel is
somewhere between its last event and its next one. Where both have the same sign, the light has
been moving one way, and the share of the time between them tells the share of the threshold: the
*phase*. Where they differ, or one of them is missing, the light turned around at a place nobody
knows, and the phase is unknown. Counts of events alone are off by up to one at each end, and always
too few after a turn; with the phase they are not.
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
        -1...1, zero where it is unknown; and whether it is known.
    """
    assert index.sites == width * height, "sites are the pixels of the sensor"
    phase = np.zeros(index.sites, np.float32)
    known = np.zeros(index.sites, np.bool_)
    _phases(index.offset, index.t_us, index.p, time_us, LONGEST_US, phase, known)
    shape = height, width
    return torch.as_tensor(phase.reshape(shape)), torch.as_tensor(known.reshape(shape))


@njit(cache=True, nogil=True)
@no_type_check
def _phases(offset, t_us, p, time_us, longest_us, phase, known):
    for site in range(len(phase)):
        first, low, high = offset[site], offset[site], offset[site + 1]
        while low < high:
            middle = (low + high) // 2
            if t_us[middle] <= time_us:
                low = middle + 1
            else:
                high = middle
        if low == first or low == offset[site + 1] or p[low] != p[low - 1]:
            continue
        gap = t_us[low] - t_us[low - 1]
        if gap > longest_us:
            continue
        known[site] = True
        if gap > 0:
            phase[site] = p[low] * (time_us - t_us[low - 1]) / gap
