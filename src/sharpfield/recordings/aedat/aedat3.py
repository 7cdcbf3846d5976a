"""AEDAT3.1, the files of iniVation's cAER: events, frames with their exposures, triggers.

Header lines that begin with `#`, up to `#!END-HEADER`, then packets of one event type each,
little-endian: a packet header of 28 bytes, and events of equal size. Times have 31 bits; a counter
in the packet header extends them. Every camera is a *source* with a number and a name, which
determines the sensor resolution.

    special     type 0, 8 bytes: valid · kind, 7 bits · time         triggers are among them
    polarity    type 1, 8 bytes: valid · polarity · y, 15 bits · x, 15 bits · time
    frame       type 2: valid · channels, 3 bits · four times · size · position · 16-bit pixels

IMU samples and packets of other modules of cAER are skipped. (0, 0) is the upper left.
Source: https://docs.inivation.com, "AEDAT 3.1"; the event types of libcaer.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple, no_type_check

import numpy as np
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import read_head
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

FIRST_LINE, LAST_LINE = b"#!AER-DAT3.1\r\n", b"#!END-HEADER\r\n"
MAX_HEADER = 2**20

SIZES = {
    "DVS128": (128, 128),
    "EDVS": (128, 128),
    "DAVIS128": (128, 128),
    "DAVIS208": (208, 192),
    "DAVIS240": (240, 180),
    "DAVIS346": (346, 260),
    "DAVIS640": (640, 480),
    "DAVISHET640": (640, 480),
    "DVXPLORER": (640, 480),
}
"""Resolution by the beginning of the source's name."""

SPECIAL, POLARITY, FRAME = 0, 1, 2

HEAD = struct.Struct("<hhiiiiii")
FRAME_HEAD = struct.Struct("<Iiiiiiiii")

MAX_PACKET = 2**28
"""Most bytes of a valid packet."""

EDGES = {
    2: (1, 0), 3: (-1, 0), 4: (1, 0),
    6: (1, 1), 7: (-1, 1), 8: (1, 1),
    9: (1, 2), 10: (-1, 2), 11: (1, 2),
    12: (1, 3), 13: (-1, 3),
}  # fmt: skip
"""Edge and channel by kind of special event; channel 3 is the camera's signal generator."""


class PacketHeader(NamedTuple):
    """Header of a packet."""

    kind: int
    source: int
    size: int
    """Bytes of an event."""
    time_at: int
    """Offset of the time in an event."""
    overflow: int
    """How often the 31-bit time has wrapped."""
    capacity: int
    count: int
    valid: int


class Packet(NamedTuple):
    """Events of one type."""

    size: int
    """Bytes of an event."""
    since_us: int
    """Offset to add to their times."""
    count: int
    data: bytes


@dataclass(frozen=True)
class Layout:
    """Offset of the first packet, and the source to read."""

    path: Path
    begin: int
    source: int
    log: ReadLog = field(default_factory=ReadLog)


def open_aedat3(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a file of cAER.

    Args:
        path: The file.
        options: `size`, where the camera's name does not determine it; `topic`, the number of one
            of several sources.

    Raises:
        CaptureError: The file is no AEDAT3.1, or has several sources and none was chosen.
    """
    start = read_head(path, MAX_HEADER)
    end = start.find(LAST_LINE)
    if not start.startswith(FIRST_LINE) or end < 0:
        raise CaptureError(
            "the file is no AEDAT3.1",
            where=path,
            got=start[:16],
            do="convert AEDAT3.0 with iniVation's DV",
        )
    named = re.findall(r"^#Source (\d{1,4}): *([^\r\n]*)", start[:end].decode("latin-1"), re.M)
    sources = {int(number): name.strip() for number, name in named}
    source = _chosen(sources, options.topic, path)
    camera = sources[source].upper()
    stated = next((size for name, size in SIZES.items() if camera.startswith(name)), None)
    size = resolve_size(stated, options.size, path)
    layout = Layout(path, end + len(LAST_LINE), source)
    return Recording(
        path,
        "AEDAT3.1",
        size,
        events=partial(_events, layout, size),
        frames=partial(_frames, layout) if camera.startswith("DAVIS") else None,
        triggers=partial(_triggers, layout),
        log=layout.log,
        notes={"camera": sources[source]},
    )


def _chosen(sources: dict[int, str], topic: str | None, path: Path) -> int:
    chosen = int(topic) if topic is not None and re.fullmatch("[0-9]{1,4}", topic) else None
    if chosen in sources:
        return chosen
    if topic is None and len(sources) == 1:
        return next(iter(sources))
    raise CaptureError(
        "the file has no source that was chosen" if sources else "the file names no source",
        where=path,
        got=", ".join(f"{number} {name}" for number, name in sources.items()),
        do="give the number of a source as topic" if sources else "copy it again",
    )


def _events(layout: Layout, size: tuple[int, int]) -> Chunks:
    layout = replace(layout, log=layout.log.start("events"))
    return merge_chunks(_raw_chunks(layout), size, where=layout.path, log=layout.log)


def _raw_chunks(layout: Layout) -> Iterator[RawChunk]:
    for packet in _packets(layout, POLARITY, 8):
        words = np.frombuffer(packet.data, "<u4").reshape(-1, 2)
        x, y, t_us, p, count = _columns(words, packet.since_us)
        layout.log.note("events marked invalid", packet.count - count)
        yield RawChunk(x, y, t_us, p)[:count]


def _triggers(layout: Layout) -> Triggers:
    layout = replace(layout, log=layout.log.start("triggers"))
    found: list[tuple[int, int, int]] = []
    for packet in _packets(layout, SPECIAL, 8):
        for word, time in struct.iter_unpack("<Ii", packet.data):
            edge = EDGES.get(word >> 1 & 0x7F)
            if word & 1 and time >= 0 and edge is not None:
                found.append((packet.since_us + time, *edge))
    t_us, edge, channel = zip(*found, strict=True) if found else ((), (), ())
    return Triggers(np.array(t_us, np.int64), np.array(edge, np.int8), np.array(channel, np.uint8))


def _frames(layout: Layout) -> Iterator[Frame]:
    layout = replace(layout, log=layout.log.start("frames"))
    for packet in _packets(layout, FRAME, FRAME_HEAD.size):
        for first in range(0, len(packet.data), packet.size):
            frame = _frame(packet.data[first : first + packet.size], packet.since_us)
            layout.log.note("damaged or partial frames", int(frame is None))
            if frame is not None:
                yield frame


def _frame(data: bytes, since_us: int) -> Frame | None:
    """Decode a frame; None if it is invalid or does not cover the whole sensor."""
    info, _, _, opened, closed, width, height, left, top = FRAME_HEAD.unpack_from(data)
    channels = info >> 1 & 7
    count = width * height * channels
    valid = info & 1 and channels in (1, 3, 4) and width > 0 and height > 0
    valid = valid and FRAME_HEAD.size + 2 * count <= len(data)
    if not valid or left or top or not 0 <= opened <= closed:
        return None
    pixels = np.frombuffer(data, "<u2", count, FRAME_HEAD.size)
    image = pixels.reshape(height, width, channels)
    image = image[..., 0] if channels == 1 else image[..., :3]
    return Frame(image.astype(np.uint16), since_us + opened, since_us + closed)


def _packets(layout: Layout, kind: int, least: int) -> Iterator[Packet]:
    """Packets of one type from the chosen source; others are skipped without reading them."""
    length = layout.path.stat().st_size
    with layout.path.open("rb") as file:
        offset = layout.begin
        while offset < length:
            start = _packet_header(file, offset)
            if start is None or (capacity := _capacity(file, offset, start, length)) is None:
                layout.log.note("truncated ends of the file")
                return
            offset += HEAD.size
            if (start.kind, start.source) == (kind, layout.source) and start.count:
                file.seek(offset)
                data = file.read(start.size * start.count)
                # Only frames may be of any size.
                if start.size == least or (kind == FRAME and start.size > least):
                    yield Packet(start.size, start.overflow << 31, start.count, data)
                else:
                    layout.log.note("damaged packets")
            offset += start.size * capacity


def _packet_header(file: BinaryIO, offset: int) -> PacketHeader | None:
    """Header of the packet at an offset; None if it is invalid."""
    file.seek(offset)
    data = file.read(HEAD.size)
    if len(data) < HEAD.size:
        return None
    found = PacketHeader(*HEAD.unpack(data))
    valid = 0 < found.size and 0 <= found.time_at < found.size and found.overflow >= 0
    valid = valid and 0 <= found.valid <= found.count <= found.capacity
    return found if valid and found.size * found.count <= MAX_PACKET else None


def _capacity(file: BinaryIO, offset: int, start: PacketHeader, length: int) -> int | None:
    """Number of event slots in a packet: its capacity, or only the events that it holds."""
    for slots in (start.capacity, start.count):
        end = offset + HEAD.size + start.size * slots
        if end == length or (end < length and _packet_header(file, end) is not None):
            return slots
    # The packet is complete, and damage follows.
    return start.count if offset + HEAD.size + start.size * start.count <= length else None


@njit(cache=True, nogil=True)
@no_type_check
def _columns(words, since_us):
    """x, y, t and p of the valid events, and their number."""
    x, y = np.empty(len(words), np.uint16), np.empty(len(words), np.uint16)
    t_us, p = np.empty(len(words), np.int64), np.empty(len(words), np.int8)
    count = 0
    for i in range(len(words)):
        word = words[i, 0]
        if word & 1 and words[i, 1] < 0x80000000:
            x[count], y[count] = word >> 17, (word >> 2) & 0x7FFF
            t_us[count], p[count] = since_us + words[i, 1], 1 if word & 2 else -1
            count += 1
    return x, y, t_us, p, count


FORMAT = Format(
    "aedat3",
    open_aedat3,
    holds="events, frames with exposures, triggers",
    marks="`#!AER-DAT3`",
    recognise=begins_with(b"#!AER-DAT3"),
    options=("size", "topic"),
)
