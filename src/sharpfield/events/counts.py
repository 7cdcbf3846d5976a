"""Numbers of events of each pixel between two times, and events aligned to a rolling shutter.

With a rolling shutter each row of a frame opens and closes a little later than the one above. If
the events of each row are shifted in time by that delay, all rows are exposed at the same time, and
code that compares frames and events of a pixel works as for a global shutter.
"""

from dataclasses import replace
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from sharpfield.core.events import EventStream
from sharpfield.events.log_path import change_between
from sharpfield.events.motion import EventMotion
from sharpfield.events.threshold import FixedThresholds

TINY = 1e-9
"""A threshold so small that events of its sign do not count."""


def counts_between(
    motion: EventMotion, start_us: int, end_us: int
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w c"]]:
    """Minus the number of OFF events, and the number of ON events, with start < t <= end.

    Whole numbers on a mono sensor with integer coordinates. For rectified positions and pixels
    behind a colour filter they are interpolated as in `events.log_path`, with c = 3 for colours.

    Args:
        motion: The events.
        start_us: Not after the end.
        end_us: Included.
    """
    events = motion.events
    if motion.channel is None and not events.rectified:
        first, last = np.searchsorted(events.t_us, (start_us, end_us), side="right")
        counts = np.zeros((2, events.height, events.width, 1), np.float32)
        part = slice(int(first), int(last))
        _count(events.x[part], events.y[part], events.p[part], counts)
        return torch.as_tensor(-counts[0]), torch.as_tensor(counts[1])
    window, channel = (start_us, end_us), motion.channel
    negative, positive = (
        change_between(events, window, only, motion.spread, channel=channel)
        for only in (FixedThresholds(1.0, TINY), FixedThresholds(TINY, 1.0))
    )
    return negative, positive


@njit(cache=True, nogil=True)
@no_type_check
def _count(x, y, p, counts):
    for i in range(len(x)):
        counts[1 if p[i] > 0 else 0, y[i], x[i], 0] += 1


def subtract_row_delay(events: EventStream, row_delay_us: float) -> EventStream:
    """The same events, each earlier by the readout delay of its row, sorted by these times.

    Args:
        events: Of the same pixels as the frames.
        row_delay_us: Readout delay from one row to the next.
    """
    if row_delay_us == 0 or not len(events):
        return events
    late = np.rint(np.asarray(events.y, np.float64) * row_delay_us).astype(np.int64)
    t_us = np.asarray(events.t_us) - late
    order = np.argsort(t_us, kind="stable")
    return replace(
        events,
        x=events.x[order],
        y=events.y[order],
        t_us=t_us[order],
        p=events.p[order],
        track=None if events.track is None else events.track[order],
    )
