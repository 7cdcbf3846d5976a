"""AEDAT4, the files of iniVation's DV software: events, frames with their exposures, triggers.

A file is a signature line, a header, and *packets*: the number of a *stream*, a size, and a
FlatBuffer, usually compressed. The header holds XML that gives the type of each stream: EVTS, FRME,
TRIG or IMUS (skipped). Times are us since 1970. A table of packets may follow, which is not needed.

The exposure of a frame is stored as its start and end; where DV leaves these out, as a duration
from the frame's own time. Frames that DV computed from events are left out.

Source: https://docs.inivation.com, "AEDAT 4.0", and the flatbuffer schemas of dv-processing.
"""

import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import Bytes, DamagedData, decompress, read_head
from sharpfield.recordings.chunks import RawChunk, merge_chunks, resolve_size
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    Frame,
    ReaderOptions,
    ReadLog,
    Recording,
    Triggers,
    begins_with,
)

FIRST_LINE = b"#!AER-DAT4.0\r\n"
COMPRESSIONS = ("none", "lz4", "lz4", "zstd", "zstd")
EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "on"],
        "formats": ["<i8", "<u2", "<u2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
PIXELS = {0: ("u1", 1), 2: ("<u2", 1), 16: ("u1", 3), 18: ("<u2", 3), 24: ("u1", 4), 26: ("<u2", 4)}
"""Data type and channels of a pixel, by OpenCV's type number; colours are stored as BGR."""

MADE_FROM_EVENTS = (2, 3, 5, 6)
"""Frame sources to skip: accumulation, motion compensation, reconstruction, visualisation."""

EDGES = {1: (1, 0), 2: (-1, 0), 3: (1, 0), 4: (1, 1), 5: (-1, 1)}
"""Edge and channel by trigger type; channel 0 is the camera's input, 1 its signal generator."""

PREFIX = 12
"""Bytes of size, root offset and identifier at the beginning."""


@dataclass(frozen=True)
class Table:
    """A table in a FlatBuffer: an offset in the buffer; all reads are bounds-checked.

    A *field* is its index in the schema; missing fields have their default value. A buffer begins
    with its size, the offset of its root table, and a file identifier of four letters. Source: the
    FlatBuffers documentation, "Internals".
    """

    data: Bytes
    offset: int

    def number(self, field: int, kind: str, default: int = 0) -> int:
        """Read a number.

        Args:
            field: Index of the field.
            kind: `struct` format character of its type: "q" for int64.
            default: Value if the table does not have the field.
        """
        where = self._field(field)
        return default if where is None else _number(self.data, where, kind)

    def vector(self, field: int, item: int) -> memoryview:
        """Bytes of a vector; empty if the table does not have the field.

        Args:
            field: Index of the field.
            item: Bytes per entry.
        """
        where = self._field(field)
        if where is None:
            return memoryview(b"")
        begin = where + _number(self.data, where, "I")
        count = _number(self.data, begin, "I")
        if count * item > len(self.data) - begin - 4:
            raise DamagedData(f"a vector of {count} entries")
        return memoryview(self.data)[begin + 4 : begin + 4 + count * item]

    def tables(self, field: int) -> list["Table"]:
        """Tables of a vector of tables."""
        offsets = self.vector(field, 4)
        if not len(offsets):
            return []
        where = self._field(field)
        assert where is not None
        begin = where + _number(self.data, where, "I") + 4
        tables = [
            begin + 4 * i + offset for i, (offset,) in enumerate(struct.iter_unpack("<I", offsets))
        ]
        return [Table(self.data, table) for table in tables]

    def _field(self, field: int) -> int | None:
        index = self.offset - _number(self.data, self.offset, "i")
        entry = 4 + 2 * field
        if entry + 2 > _number(self.data, index, "H"):
            return None
        offset = _number(self.data, index + entry, "H")
        return self.offset + offset if offset else None


def root(data: Bytes, name: str) -> Table:
    """Root table of a buffer that begins with its size.

    Raises:
        DamagedData: The identifier is another, or the buffer does not fit in the data.
    """
    if len(data) < PREFIX or data[8:12] != name.encode():
        raise DamagedData(f"no {name} buffer")
    if _number(data, 0, "I") + 4 > len(data):
        raise DamagedData("a truncated buffer")
    return Table(data, 4 + _number(data, 4, "I"))


def _number(data: Bytes, offset: int, kind: str) -> int:
    if offset < 0 or offset + struct.calcsize(f"<{kind}") > len(data):
        raise DamagedData(f"an offset to {offset} in {len(data)} bytes")
    return struct.unpack_from(f"<{kind}", data, offset)[0]


@dataclass(frozen=True)
class Stream:
    """A stream, as the header describes it."""

    number: int
    kind: str
    size: tuple[int, int] | None
    source: str


@dataclass(frozen=True)
class Layout:
    """Position of the packets, and the streams they belong to."""

    path: Path
    begin: int
    end: int
    compression: str
    streams: dict[int, Stream]
    log: ReadLog = field(default_factory=ReadLog)


def open_aedat4(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a file of DV.

    Args:
        path: The file.
        options: `size`, where the file does not give it; `topic`, which of several cameras, by its
            name in the file or by the number of a stream.

    Raises:
        CaptureError: The file is no AEDAT4, or has streams of several cameras and none was chosen.
    """
    layout = _layout(path)
    events, frames = (_chosen(layout, kind, options.topic) for kind in ("EVTS", "FRME"))
    triggers = [stream.number for stream in layout.streams.values() if stream.kind == "TRIG"]
    size, read_events = options.size, None
    if events is not None:
        size = resolve_size(layout.streams[events].size, size, path)
        read_events = partial(_events, layout, events, size)
    return Recording(
        path,
        "AEDAT4",
        size,
        events=read_events,
        frames=None if frames is None else partial(_frames, layout, frames),
        triggers=partial(_triggers, layout, triggers) if triggers else None,
        log=layout.log,
        notes={
            f"stream {stream.number}": f"{stream.kind} of {stream.source or 'unknown source'}"
            for stream in layout.streams.values()
        },
    )


def _layout(path: Path) -> Layout:
    read_head(path, 1)  # raises if there is no such file
    length = path.stat().st_size
    try:
        with path.open("rb") as file:
            if file.read(len(FIRST_LINE)) != FIRST_LINE:
                raise DamagedData("another first line")
            prefix = file.read(4)
            rest = int.from_bytes(prefix, "little")
            if len(prefix) < 4 or rest > length - file.tell():
                raise DamagedData("the header is truncated")
            header = root(prefix + file.read(rest), "IOHE")
            begin = file.tell()
        compression = header.number(0, "i")
        table = header.number(1, "q", -1)
        if not 0 <= compression < len(COMPRESSIONS):
            raise DamagedData(f"compression {compression}")
        streams = _streams(bytes(header.vector(2, 1)))
    except DamagedData as problem:
        raise CaptureError(
            "the file is no AEDAT4", where=path, got=problem, do="copy it again from the camera"
        ) from None
    layout = Layout(path, begin, length, COMPRESSIONS[compression], streams)
    if table > 0:
        layout.log.note("tables of packets beyond the end of the file", table > length)
        return Layout(path, begin, min(table, length), layout.compression, streams, layout.log)
    return layout


def _streams(xml: bytes) -> dict[int, Stream]:
    """Parse the stream descriptions; XML with entity definitions is refused."""
    if b"<!" in xml:
        raise DamagedData("definitions in the XML of the header")
    try:
        outputs = ET.fromstring(xml).find("./node[@name='outInfo']")
    except (ET.ParseError, UnicodeDecodeError, ValueError, LookupError) as error:
        raise DamagedData(f"the XML of the header: {error}") from None
    found: dict[int, Stream] = {}
    for node in () if outputs is None else outputs.findall("node"):
        number = _whole(node.get("name"))
        if number is None:
            continue
        width, height = (
            _whole(node.findtext(f"node[@name='info']/attr[@key='size{axis}']")) for axis in "XY"
        )
        found[number] = Stream(
            number,
            kind=node.findtext("attr[@key='typeIdentifier']") or "",
            size=None if width is None or height is None else (width, height),
            source=node.findtext("node[@name='info']/attr[@key='source']") or "",
        )
    if not found:
        raise DamagedData("no streams in the header")
    return found


def _whole(text: str | None) -> int | None:
    return int(text) if text and text.isascii() and text.isdigit() and len(text) < 10 else None


def _chosen(layout: Layout, kind: str, topic: str | None) -> int | None:
    """Number of the chosen stream of a type; None if there is no stream of this type."""
    found = [stream for stream in layout.streams.values() if stream.kind == kind]
    if topic is not None:
        number = _whole(topic)
        named = None if number is None else layout.streams.get(number)
        camera = named.source if named else topic
        if camera not in [stream.source for stream in layout.streams.values()]:
            raise CaptureError(
                f"no stream or camera {topic}", where=layout.path, got=_listed(layout)
            )
        found = [named] if named in found else [one for one in found if one.source == camera]
    if len(found) > 1:
        raise CaptureError(
            f"the file has several streams of {kind}",
            where=layout.path,
            got=_listed(layout),
            do=f"choose a topic: {found[0].number}, or the name of a camera",
        )
    return found[0].number if found else None


def _listed(layout: Layout) -> str:
    streams = layout.streams.values()
    return ", ".join(f"{stream.number} {stream.kind} of {stream.source}" for stream in streams)


def _events(layout: Layout, number: int, size: tuple[int, int]) -> Chunks:
    layout = replace(layout, log=layout.log.start("events"))
    return merge_chunks(_raw_chunks(layout, number), size, where=layout.path, log=layout.log)


def _raw_chunks(layout: Layout, number: int) -> Iterator[RawChunk]:
    for table in _packets(layout, [number], "EVTS"):
        try:
            stored = table.vector(0, EVENT.itemsize)
        except DamagedData:
            layout.log.note("damaged packets")
            continue
        words = np.require(np.frombuffer(stored, np.int64), requirements="A")
        yield RawChunk(*_columns(words.reshape(-1, 2)))  # [n 2]: time; x, y, polarity


def _frames(layout: Layout, number: int) -> Iterator[Frame]:
    layout = replace(layout, log=layout.log.start("frames"))
    last_us: int | None = None
    for table in _packets(layout, [number], "FRME"):
        try:
            frame = _frame(table, layout.log)
        except DamagedData:
            layout.log.note("damaged frames")
            continue
        if frame is not None and (last_us is None or frame.open_us >= last_us):
            last_us = frame.open_us
            yield frame
        elif frame is not None:
            layout.log.note("frames earlier than those before them")


def _frame(table: Table, log: ReadLog) -> Frame | None:
    """Decode a frame; None if it is none of the whole sensor."""
    if table.number(12, "b") in MADE_FROM_EVENTS:
        log.note("frames made from events")
        return None
    if table.number(8, "h") or table.number(9, "h"):
        log.note("frames of a part of the sensor")
        return None
    width, height, pixels = table.number(6, "h"), table.number(7, "h"), table.number(5, "b")
    if pixels not in PIXELS or width <= 0 or height <= 0:
        raise DamagedData(f"{width} x {height} pixels of type {pixels}")
    kind, channels = PIXELS[pixels]
    stored = np.frombuffer(table.vector(10, 1), np.uint8)
    if len(stored) != width * height * channels * np.dtype(kind).itemsize:
        raise DamagedData("another number of pixels")
    image = stored.view(kind).reshape(height, width, channels)
    image = image[..., 0] if channels == 1 else image[..., 2::-1]
    stamp_us, opened, closed = (table.number(i, "q") for i in (0, 3, 4))
    if not opened and not closed:
        opened, closed = stamp_us, stamp_us + table.number(11, "q")
    if closed < opened:
        raise DamagedData("an exposure that ends before it begins")
    return Frame(image.astype(kind[-2:]), opened, closed)


def _triggers(layout: Layout, numbers: Sequence[int]) -> Triggers:
    layout = replace(layout, log=layout.log.start("triggers"))
    found: list[tuple[int, int, int]] = []
    for packet in _packets(layout, numbers, "TRIG"):
        try:
            for table in packet.tables(0):
                edge = EDGES.get(table.number(1, "b"))
                if edge is not None:
                    found.append((table.number(0, "q"), *edge))
        except DamagedData:
            layout.log.note("damaged packets")
    t_us, edge, channel = zip(*found, strict=True) if found else ((), (), ())
    return Triggers(np.array(t_us, np.int64), np.array(edge, np.int8), np.array(channel, np.uint8))


def _packets(layout: Layout, numbers: Sequence[int], name: str) -> Iterator[Table]:
    """Valid packets of some streams; others are skipped without reading them."""
    with layout.path.open("rb") as file:
        offset = file.seek(layout.begin)
        while offset < layout.end:
            start = file.read(8)
            number, size = struct.unpack("<ii", start) if len(start) == 8 else (-1, -1)
            offset += 8 + size
            if number not in layout.streams or size < 0 or offset > layout.end:
                # Without the size, the start of the next packet is unknown.
                layout.log.note("truncated ends of the file")
                return
            if number not in numbers:
                file.seek(offset)
                continue
            try:
                table = root(decompress(file.read(size), layout.compression), name)
            except DamagedData:
                layout.log.note("damaged packets")
                continue
            yield table


@njit(cache=True, nogil=True)
@no_type_check
def _columns(words):
    """x, y, t and p of events; four times as fast as copying one column after the other."""
    x, y = np.empty(len(words), np.uint16), np.empty(len(words), np.uint16)
    t_us, p = np.empty(len(words), np.int64), np.empty(len(words), np.int8)
    for i in range(len(words)):
        t_us[i] = words[i, 0]
        word = words[i, 1]
        x[i], y[i] = word & 0xFFFF, (word >> 16) & 0xFFFF
        p[i] = 1 if (word >> 32) & 0xFF else -1
    return x, y, t_us, p


FORMAT = Format(
    "aedat4",
    open_aedat4,
    holds="events, frames with exposures, triggers",
    marks="`#!AER-DAT4`",
    recognise=begins_with(b"#!AER-DAT4"),
    options=("size", "topic"),
)
