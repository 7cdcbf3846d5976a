"""Writing Prophesee's RAW files, encoded as EVT2 or EVT3, which their tools open.

Both store integer pixels of one sensor of up to 2048 x 2048 without loss. EVT3 takes 2 to 3 bytes
per event of a real recording, EVT2 4. Their clocks wrap (after 17 s and 5 hours): where the first
event is later than that, the header states the origin of times.

Source: Prophesee, *EVT 2.0* and *EVT 3.0 format*, *RAW file format* (Metavision documentation).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, no_type_check

import numpy as np
from numba import njit

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing
from sharpfield.storage.event_file import expect_later

LARGEST = 2048
"""Maximum width and height: coordinates have 11 bits."""

WORDS = 2**20
"""Words per buffer."""

MOST_WORDS = 8
"""Maximum number of words of one event."""

STEP2, STEP3 = 2**20, 1
"""Maximum increase of the high part of the time per word: some readers detect a wrap of EVT3 only
where no step is left out, as cameras do."""

VECTOR_EVENTS = 5
"""Minimum number of neighbours of one row and time that are written as a vector (four words)."""

HIGH, LOW, ROW = range(3)
"""Indices of the encoder's state: the values of the last words, -1 before the first."""


@dataclass(frozen=True)
class Encoding:
    """One of Prophesee's encodings of events."""

    header: str
    word: str
    encode: Callable[..., Any]
    period_us: int
    """Period after which its clock wraps."""


class EvtWriter:
    """Appends events to an open file; made by `writing_evt`."""

    def __init__(self, file: BinaryIO, path: Path, like: EventStream, encoding: Encoding) -> None:
        self._file, self._path, self._like, self._encoding = file, path, like, encoding
        self._state = np.full(3, -1, np.int64)
        self._words = np.empty(WORDS, encoding.word)
        self._origin_us = 0
        self._last_us: int | None = None

    def append(self, events: EventStream) -> None:
        """Append events that are later than all earlier ones.

        Raises:
            CaptureError: They are earlier or invalid, or have rectified positions.
        """
        if not len(events):
            return
        expect_later(events, self._last_us, self._path)
        _expect_plain(events, self._path)
        if self._last_us is None:
            self._begin(int(events.t_us[0]))
        self._last_us = int(events.t_us[-1])
        x, y = events.x.astype(np.int64), events.y.astype(np.int64)
        columns, done = (x, y, events.t_us - self._origin_us, events.p), 0
        while done < len(events):
            done, count = self._encoding.encode(columns, done, self._state, self._words)
            self._file.write(self._words[:count].tobytes())

    def finish(self) -> None:
        """Write the header, if there was no event."""
        if self._last_us is None:
            self._begin(0)

    def _begin(self, first_us: int) -> None:
        period = self._encoding.period_us
        self._origin_us = first_us // period * period
        like = self._like
        lines = self._encoding.header.format(width=like.width, height=like.height)
        lines += f"% time_origin_us {self._origin_us}\n" if self._origin_us else ""
        lines += f"% bayer {like.bayer}\n" if like.bayer else ""
        self._file.write(f"{lines}% end\n".encode())


@contextmanager
def writing_evt(
    path: Path | str, like: EventStream, *, encoding: str = "evt3"
) -> Iterator[EvtWriter]:
    """A writer for `path`; the file appears when the block ends well, whole, or not at all.

    Args:
        path: The file, replaced if it exists.
        like: Any stream of the same sensor (it may be empty).
        encoding: "evt2" or "evt3".

    Raises:
        OptionError: There is no such encoding.
        CaptureError: The sensor is too large, or events are not integer pixels of one camera.
    """
    path = Path(path)
    if encoding not in ENCODINGS:
        raise OptionError(
            "unknown encoding of events", got=encoding, do=f"use {' or '.join(ENCODINGS)}"
        )
    _expect_plain(like, path)
    with replacing(path) as temporary:
        with temporary.open("wb") as file:
            writer = EvtWriter(file, path, like, ENCODINGS[encoding])
            yield writer
            writer.finish()


def _expect_plain(events: EventStream, path: Path) -> None:
    """Check that events are integer pixels of one sensor that is not too large."""
    if events.rectified or events.tracks > 1:
        raise CaptureError(
            "RAW files store integer pixels of one camera",
            where=path,
            got="rectified positions" if events.rectified else f"{events.tracks} cameras",
            do="write .h5 instead",
        )
    if max(events.width, events.height) > LARGEST:
        raise CaptureError(
            f"RAW files store sensors of up to {LARGEST} x {LARGEST} pixels",
            where=path,
            got=f"{events.width} x {events.height}",
            do="write .h5 instead",
        )


@njit(cache=True, nogil=True)
@no_type_check
def _encode_evt2(columns, first, state, words):
    """Encode events from `first` on as EVT2; returns the next event and the number of words."""
    x, y, t, p = columns
    count = 0
    i = first
    while i < t.size and count + MOST_WORDS <= words.size:
        high = t[i] >> 6
        if high != state[HIGH]:
            increase = high - state[HIGH]
            state[HIGH] = high if state[HIGH] < 0 else state[HIGH] + min(increase, STEP2)
            words[count] = 0x80000000 | (state[HIGH] & 0xFFFFFFF)
            count += 1
            continue
        words[count] = (p[i] > 0) << 28 | (t[i] & 0x3F) << 22 | x[i] << 11 | y[i]
        count += 1
        i += 1
    return i, count


@njit(cache=True, nogil=True)
@no_type_check
def _encode_evt3(columns, first, state, words):
    """EVT3, as `_encode_evt2`."""
    x, y, t, p = columns
    count = 0
    i = first
    while i < t.size and count + MOST_WORDS <= words.size:
        high, low = t[i] >> 12, t[i] & 0xFFF
        if high != state[HIGH]:
            increase = high - state[HIGH]
            state[HIGH] = high if state[HIGH] < 0 else state[HIGH] + min(increase, STEP3)
            state[LOW] = -1
            words[count] = 0x8000 | (state[HIGH] & 0xFFF)
            count += 1
            continue
        if low != state[LOW]:
            words[count] = 0x6000 | low
            state[LOW] = low
            count += 1
        if y[i] != state[ROW]:
            words[count] = y[i]
            state[ROW] = y[i]
            count += 1
        polarity = (p[i] > 0) << 11
        group = x[i] >> 5
        mask = 0
        j = i
        while j < t.size and t[j] == t[i] and y[j] == y[i] and p[j] == p[i]:
            if x[j] >> 5 != group or (j > i and x[j] <= x[j - 1]):
                break
            mask |= 1 << (x[j] & 31)
            j += 1
        if j - i >= VECTOR_EVENTS:
            words[count] = 0x3000 | polarity | group << 5
            words[count + 1] = 0x4000 | (mask & 0xFFF)
            words[count + 2] = 0x4000 | (mask >> 12 & 0xFFF)
            words[count + 3] = 0x5000 | mask >> 24
            count += 4
            i = j
        else:
            words[count] = 0x2000 | polarity | x[i]
            count += 1
            i += 1
    return i, count


SIZE = "height={height};width={width}\n% geometry {width}x{height}\n"
ENCODINGS = {
    "evt2": Encoding(f"% evt 2.0\n% format EVT2;{SIZE}", "<u4", _encode_evt2, 2**34),
    "evt3": Encoding(f"% evt 3.0\n% format EVT3;{SIZE}", "<u2", _encode_evt3, 2**24),
}
