"""ROS messages of events and of images, decoded.

    dvs_msgs, prophesee_event_msgs   EventArray: resolution; x, y, time and polarity of each event
    event_camera_msgs                EventPacket: resolution, encoding, and the payload as the
                                     camera sent it
    sensor_msgs                      Image: plain pixels; CompressedImage: PNG or JPEG

Encodings of packets are Prophesee's (see `prophesee.evt`) and these, whose times count from the
`time_base` of their packet, in ns:

    libcaer_cmp  16-bit words, type in the top 4 bits: 0 time, upper 12 bits · 1 time, lower 12 bits
                 (us, within the packet) · 2 x, 11 bits · 3 y and, in bit 11, polarity: an event
                 · 4 y and polarity of events to follow · 5 which of 8 rows from there have one
    libcaer      8 bytes: valid · polarity · y, 15 bits · x, 15 bits; and 31 bits of us
    mono         8 bytes: 32 bits of ns · x, 16 bits · y, 15 bits · polarity

Source: the message definitions of these packages, `image_encodings.h` for pixel formats, and the
package event_camera_codecs of the ros-event-camera project for encodings.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Shaped
from numba import njit

from sharpfield.recordings.bytes import DamagedData
from sharpfield.recordings.chunks import CHUNK, RawChunk, ReorderBuffer
from sharpfield.recordings.recording import ReadLog
from sharpfield.recordings.ros.bag import FieldReader, Message, Topic

ARRAYS = ("dvs_msgs/EventArray", "prophesee_event_msgs/EventArray")
PACKETS = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray")
"""The second is an earlier name of the first."""

EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("on", "u1")])
PADDED_EVENT = np.dtype(
    {
        "names": ["x", "y", "s", "ns", "on"],
        "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
        "offsets": [1, 3, 7, 11, 15],
        "itemsize": 16,
    }
)
"""ROS 2 aligns numbers, so every event but the first is preceded by three bytes of padding."""


class Packet(NamedTuple):
    """Encoded events of one message."""

    stamp_ns: int
    """When the first event reached the driver."""
    base_ns: int
    """Origin of the event times, in some encodings."""
    encoding: str
    payload: memoryview


def event_header(fields: FieldReader) -> tuple[int, tuple[int, int]]:
    """Read time in ns and sensor resolution, with which all event messages begin."""
    stamp_ns = fields.header_ns()
    height, width = fields.number("I"), fields.number("I")
    return stamp_ns, (width, height)


def event_arrays(messages: Iterable[Message], topic: Topic, log: ReadLog) -> Iterator[RawChunk]:
    """Decode the events of consecutive messages of types `ARRAYS`."""
    buffer = ReorderBuffer()
    for message in messages:
        try:
            parts = _stored(message, topic)
        except DamagedData:
            log.note("damaged messages")
            continue
        for events in parts:
            done = 0
            while done < len(events):
                count = min(len(events) - done, CHUNK - buffer.end)
                buffer.end = _decode(events[done : done + count], buffer.columns, buffer.end)
                done += count
                if buffer.end == CHUNK:
                    yield buffer.flush(last=False)
    yield buffer.flush(last=True)


def event_packet(message: Message, topic: Topic) -> Packet:
    """Payload of a message of types `PACKETS`.

    Raises:
        DamagedData: The message is truncated.
    """
    fields = FieldReader(message, topic)
    stamp_ns, _ = event_header(fields)
    fields.number("Q")
    base_ns = fields.number("Q")
    encoding = fields.text()
    fields.number("B")
    if base_ns >= 2**62:
        raise DamagedData("a time that lies centuries ahead")
    return Packet(stamp_ns, base_ns, encoding, fields.take(fields.number("I")))


def _stored(message: Message, topic: Topic) -> list[np.ndarray]:
    """Events of a message as stored, in one or two arrays."""
    fields = FieldReader(message, topic)
    event_header(fields)
    count = fields.number("I")
    if not topic.cdr or not count:
        return [np.frombuffer(fields.take(13 * count), EVENT)]
    first = np.frombuffer(fields.take(13), EVENT)
    # The last event is not padded, as nothing follows.
    return [first, np.frombuffer(fields.take(16 * (count - 1)), PADDED_EVENT)]


@njit(cache=True, nogil=True)
@no_type_check
def _decode(events, columns, end):
    """Decode events into `columns` from index `end` on; returns the new `end`."""
    x, y, t, p = columns
    e = np.uint64(end)  # unsigned: numba would look for negative indices
    for i in range(events.size):
        event = events[i]
        x[e], y[e] = event.x, event.y
        # No nanoseconds of a second come near the end of 32 bits.
        parts = (event.ns + np.uint32(500)) // np.uint32(1000)
        t[e] = np.int64(event.s) * 1_000_000 + np.int64(parts)
        p[e] = 1 if event.on else -1
        e += np.uint64(1)
    return np.int64(e)


PLAIN, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"

PIXELS: dict[str, tuple[type[np.unsignedinteger], int, str]] = {
    "mono8": (np.uint8, 1, ""),
    "8UC1": (np.uint8, 1, ""),
    "mono16": (np.uint16, 1, ""),
    "16UC1": (np.uint16, 1, ""),
    "rgb8": (np.uint8, 3, "RGB"),
    "bgr8": (np.uint8, 3, "BGR"),
    "8UC3": (np.uint8, 3, "BGR"),
    "rgba8": (np.uint8, 4, "RGB"),
    "bgra8": (np.uint8, 4, "BGR"),
    "rgb16": (np.uint16, 3, "RGB"),
    "bgr16": (np.uint16, 3, "BGR"),
    **{
        f"bayer_{tile}{bits}": (kind, 1, tile.upper())
        for tile in ("rggb", "bggr", "gbrg", "grbg")
        for bits, kind in (("8", np.uint8), ("16", np.uint16))
    },
}
"""Data type and channels of a pixel, and the order of its colours or the colour filter array."""


class StampedImage(NamedTuple):
    """A decoded image and its time."""

    stamp_ns: int
    image: Shaped[np.ndarray, "h w *c"]
    bayer: str


def decode_image(message: Message, topic: Topic) -> StampedImage:
    """Decode an image message.

    Raises:
        DamagedData: The message is truncated, or its pixel format is unknown.
    """
    fields = FieldReader(message, topic)
    stamp_ns = fields.header_ns()
    if topic.kind == COMPRESSED:
        fields.text()
        return StampedImage(stamp_ns, _decompressed(fields.take(fields.number("I"))), "")
    height, width = fields.number("I"), fields.number("I")
    encoding, big_endian, step = fields.text(), fields.number("B"), fields.number("I")
    data = np.frombuffer(fields.take(fields.number("I")), np.uint8)
    if encoding not in PIXELS:
        raise DamagedData(f"pixels of type {encoding!r}")
    kind, channels, colours = PIXELS[encoding]
    row = width * channels * np.dtype(kind).itemsize
    if not (height and width) or row > step or height * step > len(data):
        raise DamagedData("a truncated image")
    stored = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    pixels = stored.view(np.dtype(kind).newbyteorder(">" if big_endian else "<"))
    found = pixels.astype(kind).reshape(height, width, channels)
    if channels == 1:
        return StampedImage(stamp_ns, found[..., 0], colours)
    return StampedImage(stamp_ns, found[..., :3] if colours == "RGB" else found[..., 2::-1], "")


def _decompressed(data: memoryview) -> Shaped[np.ndarray, "h w *c"]:
    if not len(data):
        raise DamagedData("an empty image")
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise DamagedData(str(error)) from None
    if found is None or found.dtype not in (np.uint8, np.uint16):
        raise DamagedData("no image")
    return found if found.ndim == 2 else np.ascontiguousarray(found[..., 2::-1])


LIBCAER_ENCODINGS = ("libcaer_cmp", "libcaer", "mono")


def decode_libcaer(encoding: str, payload: memoryview, base_ns: int) -> RawChunk:
    """Decode the events of a packet.

    Args:
        encoding: One of `LIBCAER_ENCODINGS`.
        payload: The encoded events; a truncated word at the end is left out.
        base_ns: `time_base` of the packet.
    """
    if encoding == "libcaer_cmp":
        words = np.frombuffer(payload, "<u2", len(payload) // 2)
        *columns, count = _decode_libcaer_cmp(words, base_ns, _max_events(words))
        return RawChunk(*columns)[:count]
    words = np.frombuffer(payload, "<u4", len(payload) // 8 * 2).reshape(-1, 2)  # [n 2]
    return RawChunk(*(_decode_libcaer if encoding == "libcaer" else _decode_mono)(words, base_ns))


@njit(cache=True, nogil=True)
@no_type_check
def _max_events(words):
    """Upper bound of the number of events."""
    count = 0
    for i in range(words.size):
        kind = words[i] >> 12
        count += 1 if kind == 3 else 8 if kind == 5 else 0
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _decode_libcaer_cmp(words, base_ns, most):
    x, y = np.empty(most, np.uint16), np.empty(most, np.uint16)
    t_us, p = np.empty(most, np.int64), np.empty(most, np.int8)
    polarity = -1
    count = high = low = column = base = 0
    sign = -1
    for i in range(words.size):
        kind, value = words[i] >> 12, np.int64(words[i] & 0xFFF)
        bits, row = 0, base
        if kind == 0:
            high = value << 12
        elif kind == 1:
            low = value
        elif kind == 2:
            column = value & 0x7FF
        elif kind == 3:
            bits, row, polarity = 1, value & 0x7FF, 1 if value & 0x800 else -1
        elif kind == 4:
            base, sign = value & 0x7FF, 1 if value & 0x800 else -1
        elif kind == 5:
            bits, polarity = value & 0xFF, sign
            base += 8
        while bits:
            if bits & 1:
                x[count], y[count], p[count] = column, row, polarity
                t_us[count] = (base_ns + 1000 * (high | low) + 500) // 1000
                count += 1
            bits >>= 1
            row += 1
    return x, y, t_us, p, count


@njit(cache=True, nogil=True)
@no_type_check
def _decode_libcaer(words, base_ns):
    x, y = np.empty(len(words), np.uint16), np.empty(len(words), np.uint16)
    t_us, p = np.empty(len(words), np.int64), np.empty(len(words), np.int8)
    wraps = before = np.int64(0)
    for i in range(len(words)):
        word, time = words[i, 0], np.int64(words[i, 1] & 0x7FFFFFFF)
        wraps += 1 if time < before else 0
        before = time
        x[i], y[i] = word >> 17, (word >> 2) & 0x7FFF
        p[i] = 1 if word & 2 else -1
        t_us[i] = (base_ns + 500) // 1000 + (wraps << 31) + time
    return x, y, t_us, p


@njit(cache=True, nogil=True)
@no_type_check
def _decode_mono(words, base_ns):
    x, y = np.empty(len(words), np.uint16), np.empty(len(words), np.uint16)
    t_us, p = np.empty(len(words), np.int64), np.empty(len(words), np.int8)
    for i in range(len(words)):
        word = words[i, 1]
        x[i], y[i] = word & 0xFFFF, (word >> 16) & 0x7FFF
        p[i] = 1 if word >> 31 else -1
        t_us[i] = (base_ns + np.int64(words[i, 0]) + 500) // 1000
    return x, y, t_us, p
