"""Prophesee's DAT files: a text header, a record type, then eight bytes per event.

    type, 1 byte    0 or 12: events; 14: trigger edges
    size, 1 byte    8
    records         u32 time in us, u32 with the pixel and the polarity

    version 2       x in bits 0-13, y in 14-27, polarity in 28-31
    version 1       x in bits 0-8, y in 9-16, polarity in 17
    trigger edges   edge in bits 0-3, channel in 26-31

Times wrap after 71 minutes. Older files give neither the version nor the sensor resolution.

Source: Prophesee, *DAT file format* (Metavision documentation).
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import read_blocks, read_head
from sharpfield.recordings.chunks import CHUNK, RawChunk, ReorderBuffer, merge_chunks, resolve_size
from sharpfield.recordings.prophesee.evt_decode import is_outlier, wrapped_step
from sharpfield.recordings.prophesee.header import Header, header_size, names_evt, read_header
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    ReaderOptions,
    ReadLog,
    Recording,
    Triggers,
)

EVENTS, EDGES = (0, 12), 14
"""Record types."""

RECORD = 8
"""Bytes of a record."""

MAX_STEP_US = 2**28
"""A time further from the previous one than this (4.5 minutes) must be confirmed by the next."""

BIT_WIDTHS = {1: (9, 8, 1), 2: (14, 14, 4)}
"""Bits of x, y and polarity, by version."""

STARTED, TIME, OUTLIERS = range(3)
"""Decoder state: whether there was a time, the last time, and the number of outliers dropped."""


def open_dat(path: Path | str, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a DAT file.

    Args:
        path: The file.
        options: `size`, where the header does not give it.

    Raises:
        CaptureError: The file is no DAT recording, or its resolution is unknown.
    """
    path = Path(path)
    header = read_header(path)
    edges = _kind(header, path) == EDGES
    stated = header_size(header, path, options.size)
    size = stated or options.size if edges else resolve_size(stated, options.size, path)
    version = 2 if (header.number("version") or 0) >= 2 else 1
    log = ReadLog()

    def records() -> Iterator[bytes]:
        return read_blocks(path, header.length + 2)

    def events() -> Chunks:
        assert size is not None, "a file of events has a size"
        pass_log = log.start("events")
        raw_chunks = _raw_chunks(records(), BIT_WIDTHS[version], pass_log)
        return merge_chunks(raw_chunks, size, where=path, log=pass_log)

    def triggers() -> Triggers:
        return _edges(b"".join(records()))

    return Recording(
        path,
        "DAT",
        size=size,
        events=None if edges else events,
        triggers=triggers if edges else None,
        log=log,
        notes=dict(header.fields),
    )


def _kind(header: Header, path: Path) -> int:
    """Record type of a file."""
    kind = read_head(path, header.length + 2)[header.length :]
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


def _raw_chunks(
    data: Iterable[bytes], bits: tuple[int, int, int], log: ReadLog
) -> Iterator[RawChunk]:
    buffer, state = ReorderBuffer(), np.zeros(3, np.int64)
    rest = b""
    for block in chain(data, [None]):
        rest += block or b""
        records = np.frombuffer(rest, "<u4", len(rest) // RECORD * 2).reshape(-1, 2)
        # The last record waits for the one after it, which may have to confirm its time.
        ready = max(len(records) - (block is not None), 0)
        used = 0
        while used < ready:
            count = min(ready - used, CHUNK - buffer.end)
            buffer.end = _decode(records[used:], count, state, bits, buffer.columns, buffer.end)
            used += count
            if buffer.end == CHUNK:
                yield buffer.flush(last=False)
        rest = rest[used * RECORD :]
    log.note("truncated records", int(len(rest) > 0))
    log.note("times out of line with those before and after", int(state[OUTLIERS]))
    yield buffer.flush(last=True)


def _edges(data: bytes) -> Triggers:
    records = np.frombuffer(data, "<u4", len(data) // RECORD * 2).reshape(-1, 2).astype(np.int64)
    t_us, word = records.T
    wraps = np.cumsum(np.diff(t_us, prepend=t_us[:1]) < -(2**31))
    t_us = t_us + (wraps << 32)
    order = np.argsort(t_us, kind="stable")
    edge = np.where(word[order] & 0xF, 1, -1).astype(np.int8)
    return Triggers(t_us[order], edge, (word[order] >> 26).astype(np.uint8))


@njit(cache=True, nogil=True)
@no_type_check
def _decode(records, count, state, bits, columns, end):
    """Decode `count` records into `columns` from index `end` on; returns the new `end`."""
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
        if ahead < 0 or ahead > MAX_STEP_US:
            ahead = wrapped_step(time & mask, raw, mask, MAX_STEP_US)
            if abs(ahead) > MAX_STEP_US and i + 1 < len(records):
                following = np.int64(records[i + 1, 0])
                if is_outlier(time & mask, raw, following, mask, MAX_STEP_US):
                    state[OUTLIERS] += 1
                    continue
        time += ahead
        word = np.int64(records[i, 1])
        x[e], y[e] = word & in_x, (word >> at_y) & in_y
        t[e], p[e] = time, 1 if (word >> at_p) & in_p else -1
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
