"""What all ROS bags are: messages on topics; and how the bytes of a message are its fields.

A *topic* has a name and a type; its *messages* are bytes, in one of two ways: as ROS 1 has them,
one field right after the other, or as ROS 2 has them (CDR), each number aligned to its size.
How messages are kept is the matter of `recordings.ros1_bag`, `recordings.mcap` and
`recordings.sqlite_bag`.

Source: the ROS wiki, "msg"; OMG, *DDS-XTypes*, 7.4 (plain CDR).
"""

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from sharpfield.recordings.bytes import Bytes, Damaged
from sharpfield.recordings.recording import ReadLog

TEXT = 2**16
"""Bytes of the longest text in a message."""

Read = Callable[[int, int], Bytes]
"""Gives bytes from some place on: as many as asked for, or as there are."""


class Topic(NamedTuple):
    """What is sent under a name."""

    kind: str
    """Type of the messages as in ROS 1, e.g. "sensor_msgs/Image"."""
    cdr: bool
    """Whether they are serialised as in ROS 2."""


class Message(NamedTuple):
    """Something that was sent."""

    topic: str
    logged_ns: int
    """When it was recorded, by the clock of the recording computer."""
    data: Bytes


@dataclass(frozen=True)
class Bag:
    """An opened bag."""

    path: Path
    layout: str
    topics: dict[str, Topic]
    messages: Callable[[Collection[str], ReadLog], Iterator[Message]]
    """Those of some topics, in the order recorded; each call starts anew."""


def of_file(file: BinaryIO) -> Read:
    """Reads a file."""

    def read(place: int, count: int) -> bytes:
        file.seek(place)
        return file.read(count)

    return read


def of_part(part: Bytes) -> Read:
    """Reads what is in memory already, without copying."""
    whole = memoryview(part)
    return lambda place, count: whole[place : place + count]


def topic_of(kind: str, *, cdr: bool) -> Topic:
    """The topic of a type, spelled as ROS 1 or ROS 2 does."""
    return Topic(kind.replace("/msg/", "/"), cdr)


class Fields:
    """The fields of a message, taken one after the other.

    Raises:
        Damaged: (Of all methods, too.) The message is too short, or not little-endian.
    """

    def __init__(self, message: Message, topic: Topic) -> None:
        self._data = memoryview(message.data)
        self._aligned = topic.cdr
        self._at = 0
        if topic.cdr:
            # Two bytes say how it is serialised, two are not used; alignment counts after them.
            if bytes(self._data[:2]) != b"\0\1":
                raise Damaged("another serialisation than plain little-endian CDR")
            self._data = self._data[4:]

    def number(self, kind: str) -> int:
        """A number, of a type as `struct` calls it."""
        size = struct.calcsize(kind)
        if self._aligned:
            self._at += -self._at % size
        return struct.unpack(f"<{kind}", self.take(size))[0]

    def text(self) -> str:
        """A string."""
        length = self.number("I")
        if length > TEXT:
            raise Damaged(f"a text of {length} bytes")
        return bytes(self.take(length)).rstrip(b"\0").decode("utf-8", "replace")

    def take(self, count: int) -> memoryview:
        """The next bytes as they are."""
        if count > len(self._data) - self._at:
            raise Damaged("a torn message")
        self._at += count
        return self._data[self._at - count : self._at]

    def rest(self) -> memoryview:
        """All that follows."""
        return self._data[self._at :]

    def stamp_ns(self) -> int:
        """A time; in ROS 1 and 2 alike, but for a sign that no time has."""
        seconds, nanoseconds = self.number("I"), self.number("I")
        return seconds * 10**9 + nanoseconds

    def header_ns(self) -> int:
        """The time of a `std_msgs/Header`."""
        if not self._aligned:
            self.number("I")
        stamp_ns = self.stamp_ns()
        self.text()
        return stamp_ns
