"""ROS bags: messages on topics, the fields of a message, and the container of ROS 1.

A *topic* has a name and a type; its *messages* are serialised as in ROS 1, one field directly after
the other, or as in ROS 2 (CDR), each number aligned to its size.

Bags of ROS 1, version 2.0, are read from the front, so that truncated and unindexed ones are read,
too. A *record* is a header of named fields, among them the type of the record, and data. A *chunk*
is a record that holds others, possibly compressed; a *connection* maps a number to a topic;
messages give the number of their connection. The index at the end is used only to find the
connections.

Source: the ROS wiki, "msg" and "Bags/Format/2.0"; OMG, *DDS-XTypes*, 7.4 (plain CDR).
"""

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import MAX_BLOCK, Bytes, DamagedData, decompress, read_head
from sharpfield.recordings.recording import ReadLog

MAX_TEXT = 2**16
"""Most bytes of a string in a message."""

ReadBytes = Callable[[int, int], Bytes]
"""Takes an offset and a count, and returns these bytes, or as many as there are."""


class Topic(NamedTuple):
    """Type of the messages of a topic."""

    kind: str
    """Name of the type as in ROS 1, e.g. "sensor_msgs/Image"."""
    cdr: bool
    """Whether messages are serialised as in ROS 2."""


Connections = dict[int, tuple[str, Topic]]
"""Name and type of a topic by the number that messages give."""


class Message(NamedTuple):
    """A recorded message."""

    topic: str
    logged_ns: int
    """Time of recording, by the clock of the recording computer."""
    data: Bytes


@dataclass(frozen=True)
class Bag:
    """An opened bag."""

    path: Path
    layout: str
    topics: dict[str, Topic]
    messages: Callable[[Collection[str], ReadLog], Iterator[Message]]
    """Reads the messages of some topics in recorded order, from the beginning at each call."""


def file_reader(file: BinaryIO) -> ReadBytes:
    """Read from a file."""

    def read(offset: int, count: int) -> bytes:
        file.seek(offset)
        return file.read(count)

    return read


def memory_reader(data: Bytes) -> ReadBytes:
    """Read from memory, without copying."""
    view = memoryview(data)
    return lambda offset, count: view[offset : offset + count]


def topic_of(kind: str, *, cdr: bool) -> Topic:
    """Topic of a message type, whose name may be spelled as in ROS 1 or ROS 2."""
    return Topic(kind.replace("/msg/", "/"), cdr)


class FieldReader:
    """Reads the fields of a message one after the other.

    Raises:
        DamagedData: (All methods, too.) The message is too short, or not little-endian.
    """

    def __init__(self, message: Message, topic: Topic) -> None:
        self._data = memoryview(message.data)
        self._aligned = topic.cdr
        self._at = 0
        if topic.cdr:
            # Two bytes for the serialisation, two unused; alignment counts from after them.
            if bytes(self._data[:2]) != b"\0\1":
                raise DamagedData("another serialisation than plain little-endian CDR")
            self._data = self._data[4:]

    def number(self, kind: str) -> int:
        """Read a number; `kind` is the `struct` format character of its type."""
        size = struct.calcsize(kind)
        if self._aligned:
            self._at += -self._at % size
        return struct.unpack(f"<{kind}", self.take(size))[0]

    def text(self) -> str:
        """Read a string."""
        length = self.number("I")
        if length > MAX_TEXT:
            raise DamagedData(f"a text of {length} bytes")
        return bytes(self.take(length)).rstrip(b"\0").decode("utf-8", "replace")

    def take(self, count: int) -> memoryview:
        """Read bytes."""
        if count > len(self._data) - self._at:
            raise DamagedData("a truncated message")
        self._at += count
        return self._data[self._at - count : self._at]

    def rest(self) -> memoryview:
        """All remaining bytes."""
        return self._data[self._at :]

    def stamp_ns(self) -> int:
        """Read a time; ROS 1 and 2 differ only in a sign that no valid time has."""
        seconds, nanoseconds = self.number("I"), self.number("I")
        return seconds * 10**9 + nanoseconds

    def header_ns(self) -> int:
        """Read a `std_msgs/Header` and return its time."""
        if not self._aligned:
            self.number("I")
        stamp_ns = self.stamp_ns()
        self.text()
        return stamp_ns


ROS1_LINE = b"#ROSBAG V2.0\n"
MESSAGE, FILE, CHUNK, CONNECTION = 2, 3, 5, 7
MAX_HEADER = 2**20
"""Most bytes of a record header."""


class _Record(NamedTuple):
    fields: dict[bytes, bytes]
    offset: int
    size: int

    def number(self, name: bytes, size: int) -> int:
        """A field as a number; -1 if there is no field of this size."""
        value = self.fields.get(name, b"")
        return int.from_bytes(value, "little") if len(value) == size else -1

    @property
    def kind(self) -> int:
        return self.number(b"op", 1)


def open_ros1_bag(path: Path) -> Bag:
    """Open a bag.

    Raises:
        CaptureError: The file is no bag of ROS 1.
    """
    if read_head(path, len(ROS1_LINE)) != ROS1_LINE:
        raise CaptureError("the file is no bag of ROS 1, version 2.0", where=path)
    connections = _indexed(path) or _scanned(path)
    topics = dict(connections.values())

    def messages(wanted: Collection[str], log: ReadLog) -> Iterator[Message]:
        numbers = {n: name for n, (name, _) in connections.items() if name in wanted}
        return _messages(path, numbers, log)

    return Bag(path, "ROS1 bag", topics, messages)


def _indexed(path: Path) -> Connections:
    """Connections from the index; empty if there is no index, or a damaged one."""
    length = path.stat().st_size
    with path.open("rb") as file:
        try:
            start = next(_records(file_reader(file), len(ROS1_LINE), length), None)
            index = start.number(b"index_pos", 8) if start and start.kind == FILE else -1
            if index <= len(ROS1_LINE):
                return {}
            return dict(
                _connection(file_reader(file), record)
                for record in _records(file_reader(file), index, length)
                if record.kind == CONNECTION
            )
        except DamagedData:
            return {}


def _scanned(path: Path) -> Connections:
    """Connections found by reading the whole file."""
    found: Connections = {}
    for read, record in _all_records(path, ReadLog()):
        if record.kind == CONNECTION:
            try:
                found.update([_connection(read, record)])
            except DamagedData:
                continue
    return found


def _connection(read: ReadBytes, record: _Record) -> tuple[int, tuple[str, Topic]]:
    fields = _fields(bytes(read(record.offset, min(record.size, MAX_HEADER))))
    name = record.fields.get(b"topic", b"").decode("utf-8", "replace")
    kind = fields.get(b"type", b"").decode("utf-8", "replace")
    return record.number(b"conn", 4), (name, topic_of(kind, cdr=False))


def _messages(path: Path, topics: dict[int, str], log: ReadLog) -> Iterator[Message]:
    for read, record in _all_records(path, log):
        if record.kind == MESSAGE and (name := topics.get(record.number(b"conn", 4))) is not None:
            time = record.number(b"time", 8)
            logged_ns = (time & 0xFFFFFFFF) * 10**9 + (time >> 32)
            yield Message(name, logged_ns, read(record.offset, record.size))


def _all_records(path: Path, log: ReadLog) -> Iterator[tuple[ReadBytes, _Record]]:
    """Records outside and inside chunks, each with the function that reads its data."""
    length = path.stat().st_size
    with path.open("rb") as file:
        read = file_reader(file)
        try:
            for record in _records(read, len(ROS1_LINE), length):
                if record.kind != CHUNK:
                    yield read, record
                    continue
                try:
                    chunk = _chunk(read, record)
                    read_part = memory_reader(chunk)
                    for inner in _records(read_part, 0, len(chunk)):
                        yield read_part, inner
                except DamagedData:
                    log.note("damaged chunks")
        except DamagedData:
            log.note("truncated ends of the file")


def _chunk(read: ReadBytes, record: _Record) -> Bytes:
    if record.size > MAX_BLOCK:
        raise DamagedData(f"a chunk of {record.size} bytes")
    compression = record.fields.get(b"compression", b"").decode("latin-1")
    return decompress(read(record.offset, record.size), compression)


def _records(read: ReadBytes, begin: int, end: int) -> Iterator[_Record]:
    """Consecutive records, without reading their data."""
    offset = begin
    while offset < end:
        length = _number(read(offset, 4))
        if length > MAX_HEADER:
            raise DamagedData(f"a header of {length} bytes")
        fields = _fields(bytes(read(offset + 4, length)))
        size = _number(read(offset + 4 + length, 4))
        offset += 8 + length
        if offset + size > end:
            raise DamagedData("a truncated record")
        yield _Record(fields, offset, size)
        offset += size


def _fields(data: bytes) -> dict[bytes, bytes]:
    found: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        length = _number(data[at : at + 4])
        name, equals, value = data[at + 4 : at + 4 + length].partition(b"=")
        if not equals or at + 4 + length > len(data):
            raise DamagedData("a truncated field")
        found[name] = value
        at += 4 + length
    return found


def _number(data: Bytes) -> int:
    if len(data) < 4:
        raise DamagedData("a truncated number")
    return struct.unpack("<I", data)[0]
