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

EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("on", "u1")])
PADDED_EVENT = np.dtype(
    {
        "names": ["x", "y", "s", "ns", "on"],
        "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
        "offsets": [1, 3, 7, 11, 15],
        "itemsize": 16,
    }
)
"""In ROS 2 numbers are aligned, and so every event but the first has three bytes of padding."""


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
    if not topic.cdr or not count:
        return Piece(*_columns(np.frombuffer(fields.take(13 * count), EVENT)))
    first = np.frombuffer(fields.take(13), EVENT)
    # The last one is not padded, as nothing follows.
    rest = bytes(fields.take(16 * (count - 1))) if count > 1 else b""
    pieces = [_columns(first), _columns(np.frombuffer(rest, PADDED_EVENT))]
    return Piece(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))


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
def _columns(events):
    """x, y, t and p: five times as fast as numpy takes one column after the other."""
    x, y = np.empty(events.size, np.uint16), np.empty(events.size, np.uint16)
    t_us, p = np.empty(events.size, np.int64), np.empty(events.size, np.int8)
    for i in range(events.size):
        event = events[i]
        x[i], y[i] = event.x, event.y
        # No nanoseconds of a second come near the end of 32 bits.
        parts = (event.ns + np.uint32(500)) // np.uint32(1000)
        t_us[i] = np.int64(event.s) * 1_000_000 + np.int64(parts)
        p[i] = 1 if event.on else -1
    return x, y, t_us, p
