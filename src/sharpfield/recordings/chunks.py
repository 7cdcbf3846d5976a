"""Pieces of events, as files happen to have them, joined to chunks that are sound.

A file comes in packets, messages or blocks, of a few events or of millions. A reader turns each
into a `RawChunk` and leaves the rest to `joined`, which drops and counts what cannot be (events
outside the sensor, or earlier than those before them) and hands on large chunks.

Events that come a little late, put where they belong.

Sensors read out row by row, and a clock that is sent in two parts is wrong between the two: events
may come some microseconds after later ones. They are sorted as they are read, which needs the last
few of every chunk to be held back. Whatever goes back further is no matter of readout: it is left
where it is, for `pieces.joined` to judge.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Int8, Int64, UInt16
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Chunks, ReadLog

CHUNK = 2**20
"""Most events in a chunk; all but the last one have at least half as many."""

BACK_EVENTS, BACK_SHARE = 100, 0.01
"""Some cameras now and then deliver an event late. More than this many, and more than this share
of all, mean that the file is not in the order of time at all."""

OUTSIDE_EVENTS, OUTSIDE_SHARE = 100, 0.5
"""Damage puts events outside the sensor. More than this many, and more than this share of all, mean
that the size is that of another sensor, or that the columns are others."""


@dataclass(frozen=True)
class RawChunk:
    """Consecutive events, not looked at yet."""

    x: UInt16[np.ndarray, "n"]
    y: UInt16[np.ndarray, "n"]
    t_us: Int64[np.ndarray, "n"]
    p: Int8[np.ndarray, "n"]
    """-1 darker, +1 brighter."""

    def __len__(self) -> int:
        """Number of events."""
        return len(self.t_us)

    def __getitem__(self, part: slice | np.ndarray) -> "Piece":
        """A slice as views, or a choice as copies."""
        return RawChunk(self.x[part], self.y[part], self.t_us[part], self.p[part])


def joined(
    pieces: Iterator[RawChunk], size: tuple[int, int], *, where: object, trouble: ReadLog
) -> Chunks:
    """Sound chunks of half to a whole `CHUNK` of events, made of pieces of any size.

    Args:
        pieces: In the order of the file.
        size: Width and height of the sensor.
        where: The file, for messages.
        trouble: Is told what was dropped.

    Raises:
        CaptureError: The events are not in the order of time, or most of them lie outside the
            sensor.
    """
    gate = _Gate(size, where, trouble)
    waiting: list[RawChunk] = []
    count = 0
    for piece in pieces:
        sound = gate.passed(piece)
        if not waiting and CHUNK // 2 <= len(sound) <= CHUNK:
            yield _stream(sound, size)  # large enough as it is: not copied
            continue
        waiting.append(sound)
        count += len(sound)
        if count < CHUNK:
            continue
        whole = _together(waiting)
        for first in range(0, count - CHUNK + 1, CHUNK):
            yield _stream(whole[first : first + CHUNK], size)
        waiting, count = [whole[count - count % CHUNK :]], count % CHUNK
    if count:
        yield _stream(_together(waiting), size)


def known_size(
    stated: tuple[int, int] | None, given: tuple[int, int] | None, where: object
) -> tuple[int, int]:
    """Width and height of the sensor, from the file or from the caller.

    Raises:
        CaptureError: Neither says, or they contradict each other, or it is no size.
    """
    size = stated or given
    if size is None:
        raise CaptureError(
            "the file does not say how large the sensor is",
            where=where,
            do="give width and height, e.g. size 346 260",
        )
    if not (0 < size[0] <= 2**15 and 0 < size[1] <= 2**15):
        raise CaptureError("no sensor has this size", where=where, got=f"{size[0]} x {size[1]}")
    if stated and given and stated != given:
        raise CaptureError(
            "the size given is not the one in the file",
            where=where,
            got=f"{given[0]} x {given[1]} given, {stated[0]} x {stated[1]} in the file",
            do="leave the size out",
        )
    return size


def expect_inside(
    outside: int, count: int, furthest: tuple[float, float], size: tuple[int, int], where: object
) -> None:
    """Make sure that the size is that of the sensor.

    Args:
        outside: How many events lie outside.
        count: Of how many.
        furthest: The largest column and row of these.
        size: Width and height of the sensor.
        where: The file, for the message.

    Raises:
        CaptureError: Most events lie outside.
    """
    if outside > max(OUTSIDE_EVENTS, OUTSIDE_SHARE * count):
        raise CaptureError(
            "most events lie outside the sensor",
            where=where,
            got=f"{outside:,} of {count:,}, x up to {furthest[0]:g} and y up to {furthest[1]:g},"
            f" of {size[0]} x {size[1]} pixels",
            do="check the size of the sensor, and which column is which",
        )


class _Gate:
    """Lets through what lies on the sensor and does not go back in time."""

    def __init__(self, size: tuple[int, int], where: object, trouble: ReadLog) -> None:
        self._size, self._where, self._trouble = size, where, trouble
        self._last_us = np.iinfo(np.int64).min
        self._seen = self._back = self._outside = 0

    def passed(self, piece: RawChunk) -> RawChunk:
        """The sound events of the next piece."""
        if not _faultless(piece.x, piece.y, piece.t_us, *self._size, self._last_us):
            outside, back = _faults(piece.x, piece.y, piece.t_us, *self._size, self._last_us)
            keep = _sound(piece.x, piece.y, piece.t_us, *self._size, self._last_us)
            self._note(piece, outside, back, keep)
            piece = piece[keep]
        self._seen += len(piece)
        if len(piece):
            self._last_us = int(piece.t_us[-1])
        return piece

    def _note(self, piece: RawChunk, outside: int, back: int, keep: np.ndarray) -> None:
        self._trouble.note("events outside the sensor", outside)
        self._trouble.note("events earlier than those before them", back)
        self._back += back
        self._outside += outside
        count = self._seen + self._outside + int(keep.sum())
        furthest = float(piece.x.max()), float(piece.y.max())
        expect_inside(self._outside, count, furthest, self._size, self._where)
        if self._back > max(BACK_EVENTS, BACK_SHARE * (self._seen + len(piece))):
            width, height = self._size
            inside = (piece.x < width) & (piece.y < height)
            late = int(np.flatnonzero(inside & ~keep)[0])
            latest = max([self._last_us, *piece.t_us[:late][keep[:late]][-1:].tolist()])
            raise CaptureError(
                "event times are not ascending",
                where=self._where,
                got=f"event {self._seen + late} at {piece.t_us[late]} us after {latest} us,"
                f" {self._back:,} such events so far",
                do="sort the events by time (stable), and check that clock wraps were undone",
            )


def _together(pieces: list[RawChunk]) -> RawChunk:
    if len(pieces) == 1:
        return pieces[0]
    return RawChunk(
        x=np.concatenate([piece.x for piece in pieces]),
        y=np.concatenate([piece.y for piece in pieces]),
        t_us=np.concatenate([piece.t_us for piece in pieces]),
        p=np.concatenate([piece.p for piece in pieces]),
    )


def _stream(piece: RawChunk, size: tuple[int, int]) -> EventStream:
    return EventStream(piece.x, piece.y, piece.t_us, piece.p, width=size[0], height=size[1])


@njit(cache=True, nogil=True)
@no_type_check
def _faultless(x, y, t_us, width, height, last_us):
    """Whether all lie on the sensor and none goes back: in loops that look at many at a time."""
    right, below, back = np.uint16(0), np.uint16(0), np.int64(0)
    for i in range(x.size):
        right, below = max(right, x[i]), max(below, y[i])
    for i in range(1, t_us.size):
        back += np.int64(t_us[i] < t_us[i - 1])
    late = t_us.size > 0 and t_us[0] < last_us
    return right < width and below < height and back == 0 and not late


@njit(cache=True, nogil=True)
@no_type_check
def _faults(x, y, t_us, width, height, last_us):
    """How many events lie outside, and how many inside are earlier than one before."""
    outside = back = 0
    for i in range(t_us.size):
        if x[i] >= width or y[i] >= height:
            outside += 1
        elif t_us[i] < last_us:
            back += 1
        else:
            last_us = t_us[i]
    return outside, back


@njit(cache=True, nogil=True)
@no_type_check
def _sound(x, y, t_us, width, height, last_us):
    """Which events are neither."""
    keep = np.zeros(t_us.size, np.bool_)
    for i in range(t_us.size):
        if x[i] < width and y[i] < height and t_us[i] >= last_us:
            keep[i] = True
            last_us = t_us[i]
    return keep


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

    def taken(self, *, last: bool) -> RawChunk:
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
        return RawChunk(x[:cut], y[:cut], t[:cut], p[:cut])


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
