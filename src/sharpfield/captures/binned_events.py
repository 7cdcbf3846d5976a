"""Events that were summed over windows of time, made into a stream again.

A sum of n thresholds in a window becomes n events of its sign, evenly spread inside the window: the
stream reports in each window what the file says, and nothing finer than a window is to be believed.
"""

import numpy as np
from jaxtyping import Float, Int64

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream

OFF_GRID = 0.05
"""How far a sum may be from a whole number of thresholds, in thresholds."""


def unbinned(
    sums: Float[np.ndarray, "k h w"],
    edges_us: Int64[np.ndarray, "e"],
    *,
    threshold: float,
    where: object,
) -> EventStream:
    """A stream that gives these sums.

    Args:
        sums: Signed sum of thresholds in each window; natural log.
        edges_us: Where windows begin, and where the last one ends; e = k + 1.
        threshold: What one event stands for.
        where: The file, for the message.

    Raises:
        CaptureError: A sum is not finite, or not a whole number of thresholds.
    """
    number = sums.astype(np.float64) / threshold
    whole = np.rint(number)
    off = np.abs(number - whole)
    if not (off < OFF_GRID).all():  # also where it is not a number
        i = np.unravel_index(int(np.nan_to_num(off, nan=np.inf).argmax()), sums.shape)
        raise CaptureError(
            "a sum of events is not a whole number of thresholds",
            where=f"{where}, window {i[0]}, row {i[1]}, column {i[2]}",
            got=f"{sums[i]:.6g}, threshold {threshold:.6g}",
            do="give the contrast threshold that the events were weighed with",
        )
    k, y, x = np.nonzero(whole)
    count = np.abs(whole[k, y, x]).astype(np.int64)
    event = np.repeat(np.arange(len(k)), count)
    rank = np.arange(len(event)) - np.repeat(np.cumsum(count) - count, count)
    share = (rank + 0.5) / count[event]
    t_us = edges_us[k[event]] + np.floor(share * np.diff(edges_us)[k[event]]).astype(np.int64)
    order = np.argsort(t_us, kind="stable")
    event = event[order]
    return EventStream(
        x=x[event].astype(np.uint16),
        y=y[event].astype(np.uint16),
        t_us=t_us[order],
        p=np.sign(whole[k, y, x]).astype(np.int8)[event],
        width=sums.shape[2],
        height=sums.shape[1],
    )


def smallest_step(sums: Float[np.ndarray, "*n h w"]) -> float:
    """The smallest sum that is not zero: one threshold, if any window holds a single event.

    Raises:
        CaptureError: All are zero.
    """
    size = np.abs(sums[sums != 0])
    if not len(size):
        raise CaptureError("the windows hold no events", do="give the contrast threshold")
    return float(f"{size.min():.6g}")  # 0.2 is stored as 0.200000003
