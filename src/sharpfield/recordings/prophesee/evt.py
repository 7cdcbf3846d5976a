"""Prophesee's RAW files: a text header, then words of EVT2, EVT2.1 or EVT3.

Drivers of these cameras also send such words in packets over ROS; `decode_chunks` reads them from
any source. Times are those of the camera's clock, which started before the recording.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from sharpfield.core.errors import CaptureError, OptionError, did_you_mean
from sharpfield.recordings.bytes import read_blocks
from sharpfield.recordings.chunks import CHUNK, RawChunk, ReorderBuffer, merge_chunks, resolve_size
from sharpfield.recordings.prophesee.evt_decode import (
    MAX_PER_WORD,
    NO_ROW,
    ROW,
    STARTED,
    STATE_SIZE,
    UNCONFIRMED,
    UNKNOWN,
    UNTIMED,
    decode_evt2,
    decode_evt3,
    decode_evt21,
)
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

EDGES = 4096
"""Capacity for trigger edges of one call of a decoder."""

LEGACY_BEFORE = 55
"""Cameras by Prophesee with a lower `system_ID` exchange the two halves of EVT2.1 words."""


@dataclass(frozen=True)
class Encoding:
    """One of Prophesee's event encodings."""

    name: str
    word: str
    """numpy type of its words."""
    decode: Callable[..., Any]
    swapped: bool = False
    """Whether the two halves of a word are exchanged."""


ENCODINGS = {
    "evt2": Encoding("EVT2", "<u4", decode_evt2),
    "evt2.1": Encoding("EVT2.1", "<u8", decode_evt21),
    "evt2.1-legacy": Encoding("EVT2.1", "<u8", decode_evt21, swapped=True),
    "evt3": Encoding("EVT3", "<u2", decode_evt3),
}

VERSIONS = {"2.0": "evt2", "2": "evt2", "2.1": "evt2.1", "3.0": "evt3", "3": "evt3"}
NAMES = {f"EVT{version.replace('.', '')}": name for version, name in VERSIONS.items()} | {
    f"EVT{version}": name for version, name in VERSIONS.items()
}

COUNTS = {
    UNTIMED: "events before the first time",
    UNCONFIRMED: "times out of line with those before and after",
    UNKNOWN: "words of no known type",
}


def open_evt(path: Path | str, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a RAW file.

    Args:
        path: The file.
        options: `size`, where the header does not give it; `event_encoding`, one of `ENCODINGS`,
            overrules the header.

    Raises:
        CaptureError: The file is no RAW recording, or its resolution or encoding is unknown.
    """
    path = Path(path)
    header = read_header(path)
    encoding = _encoding(header, path, options.event_encoding)
    size = resolve_size(header_size(header, path, options.size), options.size, path)
    origin_us = header.number("time_origin_us") or 0
    bayer = header.fields.get("bayer", "")
    log = ReadLog()

    def words() -> Iterator[bytes]:
        return read_blocks(path, header.length)

    def events() -> Chunks:
        pass_log = log.start("events")
        for part in decode_chunks(encoding, words(), size, where=path, log=pass_log):
            yield replace(part, t_us=part.t_us + origin_us if origin_us else part.t_us, bayer=bayer)

    def triggers() -> Triggers:
        found = decode_triggers(encoding, words(), where=path)
        return replace(found, t_us=found.t_us + origin_us)

    return Recording(
        path,
        ENCODINGS[encoding].name,
        size=size,
        events=events,
        triggers=triggers,
        bayer=bayer,
        log=log,
        notes=dict(header.fields),
    )


def decode_chunks(
    encoding: str, data: Iterable[bytes], size: tuple[int, int], *, where: object, log: ReadLog
) -> Chunks:
    """Decode the events of a byte stream, which may be cut into blocks anywhere.

    Args:
        encoding: One of `ENCODINGS`.
        data: The blocks.
        size: Sensor resolution, width and height.
        where: The file, for messages.
        log: Counts what is left out.

    Raises:
        CaptureError: The words are not of this encoding, or events are not sorted by time.
    """
    decoder = _Decoder(ENCODINGS[encoding], where, log)
    return merge_chunks(decoder.raw_chunks(data), size, where=where, log=log)


def decode_triggers(encoding: str, data: Iterable[bytes], *, where: object) -> Triggers:
    """Decode the edges on the trigger inputs, sorted by time; see `decode_chunks`."""
    decoder = _Decoder(ENCODINGS[encoding], where, ReadLog())
    for _ in decoder.raw_chunks(data):
        pass
    edges = np.concatenate([np.empty((0, 3), np.int64), *decoder.edges])
    edges = edges[np.argsort(edges[:, 0], kind="stable")]
    return Triggers(edges[:, 0], edges[:, 1].astype(np.int8), edges[:, 2].astype(np.uint8))


class _Decoder:
    """Decodes consecutive blocks; keeps the state between them."""

    def __init__(self, encoding: Encoding, where: object, log: ReadLog) -> None:
        self._encoding, self._where, self._log = encoding, where, log
        self._state = np.zeros(STATE_SIZE, np.int64)
        self._state[ROW] = NO_ROW
        self._words = np.empty(0, encoding.word)
        self._partial_word = b""
        self._untimed = 0
        self._buffer = ReorderBuffer()
        self._edges = np.empty((EDGES, 3), np.int64)
        self.edges: list[Int64[np.ndarray, "n 3"]] = []

    def raw_chunks(self, data: Iterable[bytes]) -> Iterator[RawChunk]:
        """Decode all blocks."""
        for block in data:
            self._take(block)
            yield from self._decode(last=False)
        yield from self._decode(last=True)
        assert not len(self._words), "a decoder uses all words of the last block"
        self._log.note("truncated words", int(len(self._partial_word) > 0))
        if self._untimed and not self._state[STARTED]:
            raise CaptureError(
                f"there are no times in the data, as if they were no {self._encoding.name}",
                where=self._where,
                got=f"{self._untimed} events",
                do=f"check the header, or give the encoding: one of {', '.join(ENCODINGS)}",
            )
        yield self._buffer.flush(last=True)

    def _take(self, block: bytes) -> None:
        data = self._partial_word + block if self._partial_word else block
        count = len(data) // np.dtype(self._encoding.word).itemsize
        words = np.frombuffer(data, self._encoding.word, count)
        self._partial_word = data[words.nbytes :]
        if self._encoding.swapped:
            words = words >> np.uint64(32) | words << np.uint64(32)
        self._words = np.concatenate([self._words, words]) if len(self._words) else words

    def _decode(self, *, last: bool) -> Iterator[RawChunk]:
        """Decode the words read so far; yields whenever the buffer is full."""
        decode, buffer = self._encoding.decode, self._buffer
        while True:
            count = len(self._words)
            used, buffer.end, found = decode(
                self._words, self._state, last, buffer.columns, buffer.end, self._edges
            )
            self._words = self._words[used:]
            self.edges += [self._edges[:found].copy()] if found else []
            self._count_dropped(count)
            if buffer.end + MAX_PER_WORD > CHUNK:
                yield buffer.flush(last=False)
            elif not used or not len(self._words):
                return

    def _count_dropped(self, count: int) -> None:
        if self._state[UNKNOWN] > max(count // 4, 16):
            raise CaptureError(
                f"the data are no {self._encoding.name}",
                where=self._where,
                got=f"{self._state[UNKNOWN]} of {count} words are of no known type",
                do=f"check the header, or give the encoding: one of {', '.join(ENCODINGS)}",
            )
        self._untimed += int(self._state[UNTIMED])
        for index, kind in COUNTS.items():
            self._log.note(kind, int(self._state[index]))
            self._state[index] = 0


def _encoding(header: Header, path: Path, given: str | None) -> str:
    """Which of `ENCODINGS` a file uses."""
    if given is not None:
        if given not in ENCODINGS:
            raise OptionError("unknown encoding", got=given, do=did_you_mean(given, ENCODINGS))
        return given
    name, version = header.format[""], header.fields.get("evt", "")
    if not name and not version:
        raise CaptureError(
            "the file does not say how its events are encoded",
            where=path,
            got="a header without `evt` or `format`" if header.length else "no header",
            do=f"give the encoding: one of {', '.join(ENCODINGS)}",
        )
    found = NAMES.get(name.upper()) if name else VERSIONS.get(version)
    if found is None:
        raise CaptureError(
            "events are encoded in a way that cannot be read here",
            where=path,
            got=name or f"evt {version}",
            do="convert the file with the maker's tools",
        )
    return found + "-legacy" if found == "evt2.1" and _halves_swapped(header, path) else found


def _halves_swapped(header: Header, path: Path) -> bool:
    """Whether EVT2.1 words have their upper half first, as from an IMX636."""
    order = header.format.get("endianness") or header.fields.get("endianness")
    if order in ("little", "legacy"):
        return order == "legacy"
    if order is not None:
        raise CaptureError(
            "unknown order of bytes",
            where=path,
            got=order,
            do="convert the file with the maker's tools",
        )
    maker = header.fields.get("integrator_name", "Prophesee")
    system = header.number("system_id")
    return maker == "Prophesee" and system is not None and 0 < system < LEGACY_BEFORE


FORMAT = Format(
    "evt",
    open_evt,
    holds="events, triggers",
    marks="a header with `% evt`",
    recognise=lambda path, head: names_evt(head),
    suffixes=(".raw",),
    options=("size", "event_encoding"),
)
