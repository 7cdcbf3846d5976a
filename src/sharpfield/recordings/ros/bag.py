"""ROS bags of all kinds: messages on topics, and reading the fields of a message.

A *topic* has a name and a type; its *messages* are serialised as in ROS 1, one field directly after
the other, or as in ROS 2 (CDR), each number aligned to its size. The containers are read by `ros1`,
`mcap` and `sqlite`.

Source: the ROS wiki, "msg"; OMG, *DDS-XTypes*, 7.4 (plain CDR).
"""

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from sharpfield.recordings.bytes import Bytes, DamagedData
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
