"""MCAP files, which ROS 2 writes by default, read from the front: torn ones are read, too.

A *record* is its kind, its length and its content. A *chunk* holds other records, perhaps
compressed. A *schema* names a type, a *channel* ties a number to a topic and its schema. The
summary at the end is used only to learn of all channels at once.

Source: https://mcap.dev/spec.
"""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import LIMIT, Bytes, Damaged, head, unpacked
from sharpfield.recordings.recording import ReadLog
from sharpfield.recordings.ros.bag import Bag, Message, Read, Topic, of_file, of_part, topic_of

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 2, 3, 4, 5, 6, 15
FOOTER_SIZE = 9 + 20 + len(MAGIC)

Channels = dict[int, tuple[str, Topic]]
Record = tuple[int, Bytes]


def open_mcap(path: Path) -> Bag:
    """Open a file.

    Raises:
        CaptureError: It is no MCAP.
    """
    if head(path, len(MAGIC)) != MAGIC:
        raise CaptureError("the file is no MCAP", where=path)
    channels = _summarised(path) or _channels(_records(path, len(MAGIC), ReadLog()))

    def messages(wanted: Collection[str], trouble: ReadLog) -> Iterator[Message]:
        numbers = {n: name for n, (name, _) in channels.items() if name in wanted}
        for kind, content in _records(path, len(MAGIC), trouble):
            if kind == MESSAGE and len(content) >= 22:
                number, _, logged_ns = struct.unpack_from("<HIQ", content)
                if number in numbers:
                    yield Message(numbers[number], logged_ns, memoryview(content)[22:])

    return Bag(path, "ROS2 MCAP", dict(channels.values()), messages)


def _summarised(path: Path) -> Channels:
    """Channels as the summary has them; none if there is no summary."""
    length = path.stat().st_size
    if length < len(MAGIC) + FOOTER_SIZE:
        return {}
    with path.open("rb") as file:
        file.seek(length - FOOTER_SIZE)
        kind, _, start = struct.unpack("<BQQ", file.read(17))
    if kind != FOOTER or not len(MAGIC) < start < length:
        return {}
    return _channels(_records(path, start, ReadLog()))


def _channels(records: Iterator[Record]) -> Channels:
    schemas: dict[int, str] = {}
    found: Channels = {}
    for kind, content in records:
        try:
            if kind == SCHEMA:
                number, content = _number(content, "H")
                schemas[number] = _text(content)[0]
            elif kind == CHANNEL:
                number, content = _number(content, "H")
                schema, content = _number(content, "H")
                name, content = _text(content)
                encoding, _ = _text(content)
                if encoding in ("cdr", "ros1"):
                    found[number] = name, topic_of(schemas.get(schema, ""), cdr=encoding == "cdr")
        except Damaged:
            continue
    return found


def _records(path: Path, begin: int, trouble: ReadLog) -> Iterator[Record]:
    """Records outside and inside of chunks, up to the end of the data or of the summary."""
    length = path.stat().st_size
    with path.open("rb") as file:
        try:
            for kind, content in _plain(of_file(file), begin, length):
                if kind in (DATA_END, FOOTER):
                    return
                if kind != CHUNK:
                    yield kind, content
                    continue
                try:
                    data = _chunk(content)
                    yield from _plain(of_part(data), 0, len(data))
                except Damaged:
                    trouble.note("damaged chunks")
            trouble.note("torn ends of the file")
        except Damaged:
            trouble.note("torn ends of the file")


def _plain(read: Read, begin: int, end: int) -> Iterator[Record]:
    place = begin
    while start := read(place, 9):
        if len(start) < 9:
            raise Damaged("a torn record")
        kind, size = struct.unpack("<BQ", start)
        place += 9
        if size > end - place:
            if kind == CHUNK:
                # Of a recording that broke off, its last chunk may be read in part.
                yield kind, read(place, LIMIT)
            raise Damaged("a torn record")
        if kind in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
            if size > LIMIT:
                raise Damaged(f"a record of {size} bytes")
            yield kind, read(place, size)
        else:
            yield kind, b""
        place += size


def _chunk(content: Bytes) -> Bytes:
    """Its start and end, unpacked size and checksum are not needed."""
    packing, content = _text(memoryview(content)[28:])
    size, content = _number(content, "Q")
    return unpacked(content[:size], packing or "none")


def _number(data: Bytes, kind: str) -> tuple[int, Bytes]:
    size = struct.calcsize(f"<{kind}")
    if len(data) < size:
        raise Damaged("a torn record")
    return struct.unpack_from(f"<{kind}", data)[0], data[size:]


def _text(data: Bytes) -> tuple[str, Bytes]:
    length, data = _number(data, "I")
    if length > len(data):
        raise Damaged("a torn text")
    return bytes(data[:length]).decode("utf-8", "replace"), data[length:]
