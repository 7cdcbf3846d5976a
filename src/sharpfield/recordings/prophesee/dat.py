"""Prophesee's DAT files: a header of text, a type, then eight bytes per event.

    type, 1 byte    0 or 12: events; 14: trigger edges
    size, 1 byte    8
    records         u32 time in us, u32 with the place and the polarity

    version 2       x in bits 0-13, y in 14-27, polarity in 28-31
    version 1       x in bits 0-8, y in 9-16, polarity in 17
    trigger edges   edge in bits 0-3, channel in 26-31

Times wrap after 71 minutes. Older files name neither the version nor the size of the sensor.

Source: Prophesee, *DAT file format* (Metavision documentation).
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import blocks, head
from sharpfield.recordings.chunks import CHUNK, RawChunk, Reorder, joined, known_size
from sharpfield.recordings.format import NO_OPTIONS, Format, ReaderOptions
from sharpfield.recordings.prophesee.evt_decode import is_lone, step
from sharpfield.recordings.prophesee.header import Header, names_evt, read_header, stated_size
from sharpfield.recordings.recording import Chunks, ReadLog, Recording, Triggers

EVENTS, EDGES = (0, 12), 14
"""Types of records."""

RECORD = 8
"""Bytes of one."""

NEAR_US = 2**28
"""A time that is further (4.5 minutes) from the one before has to be confirmed by the next."""

PLACES = {1: (9, 8, 1), 2: (14, 14, 4)}
"""Bits of x, y and polarity by version."""

STARTED, TIME, LONE = range(3)
"""What is remembered: whether there was a time, the last one, and how many were left out."""


def open_dat(path: Path | str, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a DAT file.

    Args:
        path: Of the file.
        options: `size`, where the header does not give it.

    Raises:
        CaptureError: It is no such file, or the size is not known.
    """
    path = Path(path)
    header = read_header(path)
    edges = _kind(header, path) == EDGES
    stated = stated_size(header, path, options.size)
    size = stated or options.size if edges else known_size(stated, options.size, path)
    version = 2 if (header.number("version") or 0) >= 2 else 1
    trouble = ReadLog()

    def records() -> Iterator[bytes]:
        return blocks(path, header.length + 2)

    def events() -> Chunks:
        assert size is not None, "a file of events has a size"
        noted = trouble.anew("events")
        pieces = _pieces(records(), PLACES[version], noted)
        return joined(pieces, size, where=path, trouble=noted)

    def triggers() -> Triggers:
        return _edges(b"".join(records()))

    return Recording(
        path,
        "DAT",
        size=size,
        events=None if edges else events,
        triggers=triggers if edges else None,
        trouble=trouble,
        notes=dict(header.fields),
    )


def _kind(header: Header, path: Path) -> int:
    """What the records of a file are."""
    kind = head(path, header.length + 2)[header.length :]
    if not header.length or len(kind) < 2:
        raise CaptureError(
            "the file is no DAT recording",
            where=path,
            got="no header" if not header.length else "a header alone",
            do="copy it again",
        )
    if kind[0] not in (*EVENTS, EDGES) or kind[1] != RECORD:
        raise CaptureError(
            "the file holds records of an unknown kind",
            where=path,
            got=f"type {kind[0]}, {kind[1]} bytes each",
            do="use a file of events (type 0 or 12) or of trigger edges (type 14)",
        )
    return kind[0]


def _pieces(
    data: Iterable[bytes], bits: tuple[int, int, int], trouble: ReadLog
) -> Iterator[RawChunk]:
    room, state = Reorder(), np.zeros(3, np.int64)
    rest = b""
    for block in chain(data, [None]):
        rest += block or b""
        records = np.frombuffer(rest, "<u4", len(rest) // RECORD * 2).reshape(-1, 2)
        # The last record waits for the one after it, which may have to confirm its time.
        ready = max(len(records) - (block is not None), 0)
        used = 0
        while used < ready:
            count = min(ready - used, CHUNK - room.end)
            room.end = _decode(records[used:], count, state, bits, room.columns, room.end)
            used += count
            if room.end == CHUNK:
                yield room.taken(last=False)
        rest = rest[used * RECORD :]
    trouble.note("torn records", int(len(rest) > 0))
    trouble.note("times out of line with those before and after", int(state[LONE]))
    yield room.taken(last=True)


def _edges(data: bytes) -> Triggers:
    records = np.frombuffer(data, "<u4", len(data) // RECORD * 2).reshape(-1, 2).astype(np.int64)
    t_us, place = records.T
    wraps = np.cumsum(np.diff(t_us, prepend=t_us[:1]) < -(2**31))
    t_us = t_us + (wraps << 32)
    order = np.argsort(t_us, kind="stable")
    edge = np.where(place[order] & 0xF, 1, -1).astype(np.int8)
    return Triggers(t_us[order], edge, (place[order] >> 26).astype(np.uint8))


@njit(cache=True, nogil=True)
@no_type_check
def _decode(records, count, state, bits, columns, end):
    """Write the first `count` records from `end` on; how many events there are then."""
    x, y, t, p = columns
    e = np.uint64(end)  # unsigned: numba would look for negative indices
    in_x, in_y = (1 << bits[0]) - 1, (1 << bits[1]) - 1
    at_y, at_p = bits[0], bits[0] + bits[1]
    in_p = (1 << bits[2]) - 1
    mask = 0xFFFFFFFF
    time = state[TIME] if state[STARTED] or not count else np.int64(records[0, 0])
    for i in range(count):
        raw = np.int64(records[i, 0])
        ahead = raw - (time & mask)
        if ahead < 0 or ahead > NEAR_US:
            ahead = step(time & mask, raw, mask, NEAR_US)
            if abs(ahead) > NEAR_US and i + 1 < len(records):
                following = np.int64(records[i + 1, 0])
                if is_lone(time & mask, raw, following, mask, NEAR_US):
                    state[LONE] += 1
                    continue
        time += ahead
        place = np.int64(records[i, 1])
        x[e], y[e] = place & in_x, (place >> at_y) & in_y
        t[e], p[e] = time, 1 if (place >> at_p) & in_p else -1
        e += np.uint64(1)
    state[STARTED], state[TIME] = 1, time
    return np.int64(e)


def _recognise(path: Path, head: bytes) -> bool:
    other = path.suffix.lower() in (".raw", ".txt", ".csv")
    return head.startswith(b"%") and not names_evt(head) and not other


FORMAT = Format(
    "dat",
    open_dat,
    holds="events",
    marks="a header with `%` and no `% evt`",
    recognise=_recognise,
    suffixes=(".dat",),
)
