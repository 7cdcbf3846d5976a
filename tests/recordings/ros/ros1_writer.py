"""Writing bags of ROS 1: a recording as the driver of a DAVIS would have sent it.

    <name>/events               dvs_msgs/EventArray
    <name>/image_raw            sensor_msgs/Image, stamped when its exposure began
    <name>/image_raw/exposure   sensor_msgs/TimeReference: that stamp, and when it ended

Source: the message definitions of dvs_msgs (rpg_dvs_ros) and of common_msgs.
"""

import struct
from collections.abc import Callable, Iterator
from heapq import merge
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, checked
from sharpfield.core.files import replacing
from sharpfield.recordings.recording import Frame, Recording
from sharpfield.recordings.ros.event_messages import EVENT, PIXELS

EVENTS, IMAGES, EXPOSURES = "events", "image_raw", "image_raw/exposure"

TYPES = {
    EVENTS: "dvs_msgs/msg/EventArray",
    IMAGES: "sensor_msgs/msg/Image",
    EXPOSURES: "sensor_msgs/msg/TimeReference",
}
EVENT_TYPES = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\ntime ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": "Header header\nuint32 height\nuint32 width\nEvent[] events\n",
}


MESSAGE = 2**15
"""Most events in a message."""

LAST_US = 2**32 * 10**6
"""ROS 1 ends in 2106, and begins in 1970."""


class _Message(NamedTuple):
    begin_us: int
    topic: str
    data: bytes


def write_ros1_bag(path: Path, recording: Recording, *, name: str = "/dvs") -> None:
    """Write events and frames of a recording; a file at `path` is replaced.

    Trigger edges have no message in ROS and are left out.

    Args:
        path: Of the file, `.bag`.
        recording: Of any layout; it is read piece by piece.
        name: What topics begin with.

    Raises:
        CaptureError: Events are unsound, an image is neither grey nor RGB, or a time lies outside
            1970 to 2106.
    """
    bags: Any = import_module("rosbags.rosbag1")
    types = _types(import_module("rosbags.typesys"))
    with replacing(path) as temporary:
        temporary.unlink()  # the writer wants to make it
        with bags.Writer(temporary) as writer:
            connections: dict[str, Any] = {}
            for message in merge(*_messages(recording, path), key=lambda one: one.begin_us):
                topic = message.topic
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        f"{name}/{topic}", TYPES[topic], typestore=types
                    )
                # The very first moment of 1970 means "no time" in ROS.
                logged_ns = max(1000 * message.begin_us, 1)
                writer.write(connections[topic], logged_ns, message.data)


def _types(systems: Any) -> Any:
    """Definitions of the messages, with which bags are self-contained."""
    types = systems.get_typestore(systems.Stores.ROS1_NOETIC)
    for name, text in EVENT_TYPES.items():
        types.register(systems.get_types_from_msg(text, name))
    return types


def _messages(recording: Recording, path: Path) -> Iterator[Iterator[_Message]]:
    if recording.events is not None:
        yield _event_messages(recording, path)
    if recording.frames is not None:
        yield _frame_messages(recording.frames, recording.bayer, path)


def _event_messages(recording: Recording, path: Path) -> Iterator[_Message]:
    for chunk in recording.chunks():
        checked(chunk, path)
        if chunk.rectified:
            raise CaptureError("bags of ROS hold whole pixels, not rectified events", where=path)
        for first in range(0, len(chunk), MESSAGE):
            part = chunk[first : first + MESSAGE]
            begin_us = int(part.t_us[0])
            data = _header(int(part.t_us[-1]), path) + _events(part)
            yield _Message(_expected(begin_us, path), EVENTS, data)


def _events(part: EventStream) -> bytes:
    stored = np.empty(len(part), EVENT)
    stored["x"], stored["y"], stored["on"] = part.x, part.y, part.p > 0
    stored["s"], microseconds = np.divmod(part.t_us, 10**6)
    stored["ns"] = microseconds * 1000
    return struct.pack("<III", part.height, part.width, len(part)) + stored.tobytes()


def _frame_messages(
    frames: Callable[[], Iterator[Frame]], bayer: str, path: Path
) -> Iterator[_Message]:
    for frame in frames():
        height, width, *colours = frame.image.shape
        encoding = _encoding(frame.image, "" if colours else bayer, path)
        pixels = np.ascontiguousarray(frame.image).tobytes()
        start = _header(frame.open_us, path)
        image = struct.pack("<II", height, width) + _text(encoding)
        image += struct.pack("<BII", 0, len(pixels) // height, len(pixels)) + pixels
        yield _Message(frame.open_us, IMAGES, start + image)
        end = _time(frame.close_us, path) + _text("end of exposure")
        yield _Message(frame.open_us, EXPOSURES, start + end)


def _encoding(image: np.ndarray, bayer: str, path: Path) -> str:
    wanted = (image.dtype, (*image.shape, 1)[2], bayer or ("RGB" if image.ndim == 3 else ""))
    for name, (kind, channels, colours) in PIXELS.items():
        if wanted == (np.dtype(kind), channels, colours) and image.ndim in (2, 3):
            return name
    raise CaptureError(
        "bags of ROS hold grey, raw or RGB images of 8 or 16 bits",
        where=path,
        got=f"{image.dtype} of shape {image.shape}",
    )


def _header(time_us: int, path: Path) -> bytes:
    """A `std_msgs/Header`: a number that ROS has long ignored, a time, and the name of a frame."""
    return struct.pack("<I", 0) + _time(time_us, path) + _text("")


def _time(time_us: int, path: Path) -> bytes:
    seconds, microseconds = divmod(_expected(time_us, path), 10**6)
    return struct.pack("<II", seconds, 1000 * microseconds)


def _expected(time_us: int, path: Path) -> int:
    if not 0 <= time_us < LAST_US:
        raise CaptureError(
            "times in bags of ROS lie between 1970 and 2106",
            where=path,
            got=f"{time_us} us since 1970",
            do="shift the recording in time",
        )
    return time_us


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data
