"""Events as files store them, checked, sorted and merged into chunks of bounded size.

A file comes in packets, messages or blocks of a few events or of millions. A reader decodes each
into a `RawChunk`; `merge_chunks` drops and counts invalid events (outside the sensor, or earlier
than the events before them) and yields large chunks.

Events that arrive slightly late are sorted first, by a `ReorderBuffer`. Sensors are read out row
by row, and a time sent in two words is wrong between the two: events may come some microseconds
after later ones. Sorting needs the last events of each chunk to be held back. Events that are
later than that are not a matter of readout; they stay in place for `merge_chunks` to judge.
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
"""Most events in a chunk; all chunks but the last have at least half as many."""

MAX_BACKWARD_EVENTS, MAX_BACKWARD_SHARE = 100, 0.01
"""Some cameras now and then deliver an event late. More than this many, and more than this share
of all events, mean that the file is not sorted by time at all."""

MAX_OUTSIDE_EVENTS, MAX_OUTSIDE_SHARE = 100, 0.5
"""Damage puts events outside the sensor. More than this many, and more than this share of all
events, mean that the resolution is that of another sensor, or that columns are exchanged."""

MAX_DELAY_US = 4096
"""How late an event may come and still be sorted: one step of the high time word of EVT3."""

MAX_HELD_BACK = CHUNK // 4
"""Most events that are held back."""

MAX_MEAN_MOVES = 64
"""Most positions that an event is moved on average over a chunk; bounds the time of sorting."""


@dataclass(frozen=True)
class RawChunk:
    """Consecutive events, not validated yet."""

    x: UInt16[np.ndarray, "n"]
    y: UInt16[np.ndarray, "n"]
    t_us: Int64[np.ndarray, "n"]
    p: Int8[np.ndarray, "n"]
    """-1 darker, +1 brighter."""

    def __len__(self) -> int:
        """Number of events."""
        return len(self.t_us)

    def __getitem__(self, part: slice | np.ndarray) -> "RawChunk":
        """A slice as views, or selected events as copies."""
        return RawChunk(self.x[part], self.y[part], self.t_us[part], self.p[part])


def merge_chunks(
    raw_chunks: Iterator[RawChunk], size: tuple[int, int], *, where: object, log: ReadLog
) -> Chunks:
    """Merge raw chunks of any size into valid chunks of `CHUNK` / 2 to `CHUNK` events.

    Args:
        raw_chunks: In the order of the file.
        size: Sensor resolution, width and height.
        where: The file, for messages.
        log: Counts what is dropped.

    Raises:
        CaptureError: Events are not sorted by time, or most of them lie outside the sensor.
    """
    validator = _Validator(size, where, log)
    waiting: list[RawChunk] = []
    count = 0
    for raw in raw_chunks:
        valid = validator.validated(raw)
        if not waiting and CHUNK // 2 <= len(valid) <= CHUNK:
            yield _stream(valid, size)  # large enough as it is: not copied
            continue
        waiting.append(valid)
        count += len(valid)
        if count < CHUNK:
            continue
        whole = _concatenated(waiting)
        for first in range(0, count - CHUNK + 1, CHUNK):
            yield _stream(whole[first : first + CHUNK], size)
        waiting, count = [whole[count - count % CHUNK :]], count % CHUNK
    if count:
        yield _stream(_concatenated(waiting), size)


def resolve_size(
    stated: tuple[int, int] | None, given: tuple[int, int] | None, where: object
) -> tuple[int, int]:
    """Sensor resolution, width and height, from the file or from the caller.

    Raises:
        CaptureError: Neither gives it, they contradict each other, or it is out of range.
    """
    size = stated or given
    if size is None:
        raise CaptureError(
            "the file does not state its sensor resolution",
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
    """Check that the resolution is that of the sensor.

    Args:
        outside: Number of events outside the sensor.
        count: Number of all events.
        furthest: Largest column and row among the events outside.
        size: Sensor resolution, width and height.
        where: The file, for the message.

    Raises:
        CaptureError: Most events lie outside.
    """
    if outside > max(MAX_OUTSIDE_EVENTS, MAX_OUTSIDE_SHARE * count):
        raise CaptureError(
            "most events lie outside the sensor",
            where=where,
            got=f"{outside:,} of {count:,}, x up to {furthest[0]:g} and y up to {furthest[1]:g},"
            f" of {size[0]} x {size[1]} pixels",
            do="check the size of the sensor, and which column is which",
        )


class ReorderBuffer:
    """Buffer for one chunk of decoded events, flushed in the order of time."""

    def __init__(self) -> None:
        self.columns = _columns()
        """x, y, t and p; decoders write from index `end` on."""
        self.end = 0
        """Number of events in the buffer."""

    def flush(self, *, last: bool) -> RawChunk:
        """Take the events out, except those that late events may still have to precede.

        Args:
            last: Whether no more events will come, so that none is held back.
        """
        x, y, t, p = (column[: self.end] for column in self.columns)
        if (t[1:] < t[:-1]).any():
            _sort(x, y, t, p)
        cut = len(t)
        if not last and cut:
            first = int(np.searchsorted(t, t[-1] - MAX_DELAY_US))
            cut = max(first, len(t) - MAX_HELD_BACK)
        held_back = [column[cut:] for column in (x, y, t, p)]
        self.columns, self.end = _columns(), len(t) - cut
        for column, rest in zip(self.columns, held_back, strict=True):
            column[: self.end] = rest
        return RawChunk(x[:cut], y[:cut], t[:cut], p[:cut])


class _Validator:
    """Drops events that lie outside the sensor or go back in time, over consecutive chunks."""

    def __init__(self, size: tuple[int, int], where: object, log: ReadLog) -> None:
        self._size, self._where, self._log = size, where, log
        self._last_us = np.iinfo(np.int64).min
        self._valid = self._backward = self._outside = 0

    def validated(self, raw: RawChunk) -> RawChunk:
        """The valid events of the next chunk."""
        if not _all_valid(raw.x, raw.y, raw.t_us, *self._size, self._last_us):
            keep, outside, backward = _valid(raw.x, raw.y, raw.t_us, *self._size, self._last_us)
            self._count(raw, outside, backward, keep)
            raw = raw[keep]
        self._valid += len(raw)
        if len(raw):
            self._last_us = int(raw.t_us[-1])
        return raw

    def _count(self, raw: RawChunk, outside: int, backward: int, keep: np.ndarray) -> None:
        self._log.note("events outside the sensor", outside)
        self._log.note("events earlier than those before them", backward)
        self._backward += backward
        self._outside += outside
        count = self._valid + self._outside + int(keep.sum())
        furthest = float(raw.x.max()), float(raw.y.max())
        expect_inside(self._outside, count, furthest, self._size, self._where)
        limit = max(MAX_BACKWARD_EVENTS, MAX_BACKWARD_SHARE * (self._valid + len(raw)))
        if self._backward > limit:
            width, height = self._size
            inside = (raw.x < width) & (raw.y < height)
            late = int(np.flatnonzero(inside & ~keep)[0])
            latest = max([self._last_us, *raw.t_us[:late][keep[:late]][-1:].tolist()])
            raise CaptureError(
                "event times are not ascending",
                where=self._where,
                got=f"event {self._valid + late} at {raw.t_us[late]} us after {latest} us,"
                f" {self._backward:,} such events so far",
                do="sort the events by time (stable), and check that clock wraps were undone",
            )


def _concatenated(chunks: list[RawChunk]) -> RawChunk:
    if len(chunks) == 1:
        return chunks[0]
    names = ("x", "y", "t_us", "p")
    return RawChunk(*(np.concatenate([getattr(one, name) for one in chunks]) for name in names))


def _stream(chunk: RawChunk, size: tuple[int, int]) -> EventStream:
    return EventStream(chunk.x, chunk.y, chunk.t_us, chunk.p, width=size[0], height=size[1])


def _columns() -> tuple[np.ndarray, ...]:
    return tuple(np.empty(CHUNK, kind) for kind in (np.uint16, np.uint16, np.int64, np.int8))


@njit(cache=True, nogil=True)
@no_type_check
def _all_valid(x, y, t_us, width, height, last_us):
    """Whether all events are valid; branch-free loops, which the compiler vectorises."""
    right, below, backward = np.uint16(0), np.uint16(0), np.int64(0)
    for i in range(x.size):
        right, below = max(right, x[i]), max(below, y[i])
    for i in range(1, t_us.size):
        backward += np.int64(t_us[i] < t_us[i - 1])
    late = t_us.size > 0 and t_us[0] < last_us
    return right < width and below < height and backward == 0 and not late


@njit(cache=True, nogil=True)
@no_type_check
def _valid(x, y, t_us, width, height, last_us):
    """Mask of the valid events; how many lie outside the sensor, and how many others go back."""
    keep, outside, backward = np.zeros(t_us.size, np.bool_), 0, 0
    for i in range(t_us.size):
        if x[i] >= width or y[i] >= height:
            outside += 1
        elif t_us[i] < last_us:
            backward += 1
        else:
            keep[i], last_us = True, t_us[i]
    return keep, outside, backward


@njit(cache=True, nogil=True)
@no_type_check
def _sort(x, y, t, p):
    """Insertion sort that moves an event by at most `MAX_DELAY_US`; stable."""
    moves = MAX_MEAN_MOVES * t.size
    for i in range(1, t.size):
        time, column, row, sign = t[i], x[i], y[i], p[i]
        j = i
        while j > 0 and t[j - 1] > time and t[j - 1] - time <= MAX_DELAY_US and moves > 0:
            t[j], x[j], y[j], p[j] = t[j - 1], x[j - 1], y[j - 1], p[j - 1]
            j -= 1
            moves -= 1
        t[j], x[j], y[j], p[j] = time, column, row, sign
