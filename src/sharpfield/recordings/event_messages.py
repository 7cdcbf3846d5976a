"""Messages of events, as drivers of event cameras send them over ROS.

    dvs_msgs, prophesee_event_msgs   EventArray: size of the sensor; x, y, time and polarity of each
    event_camera_msgs                EventPacket: size of the sensor, an encoding, and the payload
                                     as the camera sent it

Source: the message definitions of these packages.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from sharpfield.recordings.bag import Fields, Message, Topic
from sharpfield.recordings.pieces import Piece
from sharpfield.recordings.unpacking import Damaged

ARRAYS = ("dvs_msgs/EventArray", "prophesee_event_msgs/EventArray")
PACKETS = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray")
"""The second is what the first was called before."""


class Start(NamedTuple):
    """What an event message says before its events."""

    stamp_ns: int
    size: tuple[int, int]


class Packet(NamedTuple):
    """Encoded events."""

    stamp_ns: int
    """When the first of them reached the driver."""
    base_ns: int
    """What their times count from, in some encodings."""
    encoding: str
    payload: memoryview


def start(fields: Fields) -> Start:
    """Time and size of the sensor, with which all messages of events begin."""
    stamp_ns = fields.header_ns()
    height, width = fields.number("I"), fields.number("I")
    return Start(stamp_ns, (width, height))


def event_array(message: Message, topic: Topic) -> Piece:
    """The events of a message of `ARRAYS`.

    Raises:
        Damaged: It is torn.
    """
    fields = Fields(message, topic)
    start(fields)
    count = fields.number("I")
    data = np.frombuffer(fields.rest(), np.uint8)
    if topic.cdr:
        # Numbers are aligned: after the first event, each begins two bytes beyond a multiple of 4.
        places, first, stride = np.array([0, 2, 6, 10, 14]), 14, 16
        needed = 13 + 14 * (count > 1) + 16 * max(count - 2, 0)
    else:
        places, first, stride = np.array([0, 2, 4, 8, 12]), 13, 13
        needed = 13 * count
    if count and needed + 2 * topic.cdr * (count > 1) > len(data):
        raise Damaged("a torn message")
    return Piece(*_events(data, count, places, first, stride))


def event_packet(message: Message, topic: Topic) -> Packet:
    """The payload of a message of `PACKETS`.

    Raises:
        Damaged: It is torn.
    """
    fields = Fields(message, topic)
    stamp_ns, _ = start(fields)
    fields.number("Q")
    base_ns = fields.number("Q")
    encoding = fields.text()
    fields.number("B")
    if base_ns >= 2**62:
        raise Damaged("a time that lies centuries ahead")
    return Packet(stamp_ns, base_ns, encoding, fields.take(fields.number("I")))


@njit(cache=True, nogil=True)
@no_type_check
def _events(data, count, places, first, stride):
    """x, y, t and p of records of 16-bit x and y, seconds and nanoseconds, and a byte."""
    x, y = np.empty(count, np.uint16), np.empty(count, np.uint16)
    t_us, p = np.empty(count, np.int64), np.empty(count, np.int8)
    at, skip = 0, stride - first
    for i in range(count):
        # The first record of ROS 2 is not padded between y and the time.
        gap = skip if i == 0 else 0
        x[i] = data[at] | data[at + 1] << 8
        y[i] = data[at + places[1]] | data[at + places[1] + 1] << 8
        seconds = _word(data, at + places[2] - gap)
        nanoseconds = _word(data, at + places[3] - gap)
        t_us[i] = seconds * 1_000_000 + (nanoseconds + 500) // 1000
        p[i] = 1 if data[at + places[4] - gap] else -1
        at += stride - gap
    return x, y, t_us, p


@njit(cache=True, nogil=True)
@no_type_check
def _word(data, at):
    low = np.int64(data[at]) | np.int64(data[at + 1]) << 8
    return low | np.int64(data[at + 2]) << 16 | np.int64(data[at + 3]) << 24
