"""Bags of ROS 1, version 2.0, read from the front: torn and unindexed ones are read, too.

A *record* is a header of named fields, among them the kind of record, and data. A *chunk* is a
record that holds others, perhaps compressed; a *connection* ties a number to a topic; messages
name their connection. The index at the end is used only to learn of all connections at once.

Source: the ROS wiki, "Bags/Format/2.0".
"""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import LIMIT, Bytes, Damaged, head, unpacked
from sharpfield.recordings.recording import ReadLog
from sharpfield.recordings.ros.bag import Bag, Message, Read, Topic, of_file, of_part, topic_of

FIRST_LINE = b"#ROSBAG V2.0\n"
MESSAGE, FILE, CHUNK, CONNECTION = 2, 3, 5, 7
LONGEST = 2**20
"""Bytes of a record's header."""


class _Record(NamedTuple):
    fields: dict[bytes, bytes]
    place: int
    size: int

    def number(self, name: bytes, size: int) -> int:
        """A field, or -1 if there is none of this size."""
        value = self.fields.get(name, b"")
        return int.from_bytes(value, "little") if len(value) == size else -1

    @property
    def kind(self) -> int:
        return self.number(b"op", 1)


def open_ros1_bag(path: Path) -> Bag:
    """Open a bag.

    Raises:
        CaptureError: It is none.
    """
    if head(path, len(FIRST_LINE)) != FIRST_LINE:
        raise CaptureError("the file is no bag of ROS 1, version 2.0", where=path)
    connections = _indexed(path) or _scanned(path)
    topics = dict(connections.values())

    def messages(wanted: Collection[str], trouble: ReadLog) -> Iterator[Message]:
        numbers = {n: name for n, (name, _) in connections.items() if name in wanted}
        return _messages(path, numbers, trouble)

    return Bag(path, "ROS1 bag", topics, messages)


Connections = dict[int, tuple[str, Topic]]


def _indexed(path: Path) -> Connections:
    """Connections as the index has them; none if there is no index, or a damaged one."""
    length = path.stat().st_size
    with path.open("rb") as file:
        try:
            start = next(_records(of_file(file), len(FIRST_LINE), length), None)
            index = start.number(b"index_pos", 8) if start and start.kind == FILE else -1
            if index <= len(FIRST_LINE):
                return {}
            return dict(
                _connection(of_file(file), record)
                for record in _records(of_file(file), index, length)
                if record.kind == CONNECTION
            )
        except Damaged:
            return {}


def _scanned(path: Path) -> Connections:
    """Connections as they come by."""
    found: Connections = {}
    for read, record in _all_records(path, ReadLog()):
        if record.kind == CONNECTION:
            try:
                found.update([_connection(read, record)])
            except Damaged:
                continue
    return found


def _connection(read: Read, record: _Record) -> tuple[int, tuple[str, Topic]]:
    fields = _fields(bytes(read(record.place, min(record.size, LONGEST))))
    name = record.fields.get(b"topic", b"").decode("utf-8", "replace")
    kind = fields.get(b"type", b"").decode("utf-8", "replace")
    return record.number(b"conn", 4), (name, topic_of(kind, cdr=False))


def _messages(path: Path, topics: dict[int, str], trouble: ReadLog) -> Iterator[Message]:
    for read, record in _all_records(path, trouble):
        if record.kind == MESSAGE and (name := topics.get(record.number(b"conn", 4))) is not None:
            time = record.number(b"time", 8)
            logged_ns = (time & 0xFFFFFFFF) * 10**9 + (time >> 32)
            yield Message(name, logged_ns, read(record.place, record.size))


def _all_records(path: Path, trouble: ReadLog) -> Iterator[tuple[Read, _Record]]:
    """Records outside and inside of chunks, with what to read their data from."""
    length = path.stat().st_size
    with path.open("rb") as file:
        read = of_file(file)
        try:
            for record in _records(read, len(FIRST_LINE), length):
                if record.kind != CHUNK:
                    yield read, record
                    continue
                try:
                    chunk = _chunk(read, record)
                    read_part = of_part(chunk)
                    for inner in _records(read_part, 0, len(chunk)):
                        yield read_part, inner
                except Damaged:
                    trouble.note("damaged chunks")
        except Damaged:
            trouble.note("torn ends of the file")


def _chunk(read: Read, record: _Record) -> Bytes:
    if record.size > LIMIT:
        raise Damaged(f"a chunk of {record.size} bytes")
    packing = record.fields.get(b"compression", b"").decode("latin-1")
    return unpacked(read(record.place, record.size), packing)


def _records(read: Read, begin: int, end: int) -> Iterator[_Record]:
    """Consecutive records; their data are not read."""
    place = begin
    while place < end:
        length = _number(read(place, 4))
        if length > LONGEST:
            raise Damaged(f"a header of {length} bytes")
        fields = _fields(bytes(read(place + 4, length)))
        size = _number(read(place + 4 + length, 4))
        place += 8 + length
        if place + size > end:
            raise Damaged("a torn record")
        yield _Record(fields, place, size)
        place += size


def _fields(data: bytes) -> dict[bytes, bytes]:
    found: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        length = _number(data[at : at + 4])
        name, equals, value = data[at + 4 : at + 4 + length].partition(b"=")
        if not equals or at + 4 + length > len(data):
            raise Damaged("a torn field")
        found[name] = value
        at += 4 + length
    return found


def _number(data: Bytes) -> int:
    if len(data) < 4:
        raise Damaged("a torn number")
    return struct.unpack("<I", data)[0]
