"""Events that come a little late, put where they belong.

Sensors read out row by row, and a clock that is sent in two parts is wrong between the two: events
may come some microseconds after later ones. They are sorted as they are read, which needs the last
few of every chunk to be held back. Whatever goes back further is no matter of readout: it is left
where it is, for `pieces.joined` to judge.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sharpfield.recordings.pieces import CHUNK, Piece

REACH_US = 4096
"""How late an event may come: one step of the slower part of an EVT3 clock."""

HELD = CHUNK // 4
"""Most events that are held back."""

MOVES = 64
"""Most events that one is moved past, on average over a chunk; more is no matter of readout."""


class Reorder:
    """Room for a chunk of events, filled from the front and emptied in the order of time."""

    def __init__(self) -> None:
        self.columns = _columns()
        """x, y, t and p, to write to from `end` on."""
        self.end = 0
        """How many events are there."""

    def taken(self, *, last: bool) -> Piece:
        """The events so far, but for those that may have to wait for late ones.

        Args:
            last: Whether no more will come, so that none has to wait.
        """
        x, y, t, p = (column[: self.end] for column in self.columns)
        if not _ascending(t):
            _sort(x, y, t, p)
        cut = len(t)
        if not last and cut:
            first = int(np.searchsorted(t, t[-1] - REACH_US))
            cut = max(first, len(t) - HELD)
        held = [column[cut:] for column in (x, y, t, p)]
        self.columns, self.end = _columns(), len(t) - cut
        for column, rest in zip(self.columns, held, strict=True):
            column[: self.end] = rest
        return Piece(x[:cut], y[:cut], t[:cut], p[:cut])


def _columns() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    kinds = (np.uint16, np.uint16, np.int64, np.int8)
    x, y, t, p = (np.empty(CHUNK, kind) for kind in kinds)
    return x, y, t, p


@njit(cache=True, nogil=True)
@no_type_check
def _ascending(t):
    back = 0
    for i in range(1, t.size):
        back += t[i] < t[i - 1]
    return back == 0


@njit(cache=True, nogil=True)
@no_type_check
def _sort(x, y, t, p):
    """Move each event before those that are later by at most `REACH_US`; ties keep their order."""
    moves = MOVES * t.size
    for i in range(1, t.size):
        time, column, row, sign = t[i], x[i], y[i], p[i]
        j = i
        while j > 0 and t[j - 1] > time and t[j - 1] - time <= REACH_US and moves > 0:
            t[j], x[j], y[j], p[j] = t[j - 1], x[j - 1], y[j - 1], p[j - 1]
            j -= 1
            moves -= 1
        t[j], x[j], y[j], p[j] = time, column, row, sign
