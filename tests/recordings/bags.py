"""Bags of ROS, written with another library, and messages made byte by byte."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sharpfield.core.events import EventStream

TYPES = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events\n"
    ),
    "event_camera_msgs/msg/EventPacket": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
        "string encoding\nbool is_bigendian\nuint8[] events\n"
    ),
}
ARRAY, PACKET = "dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

Sent = tuple[str, str, Any, int]
"""Topic, type, message and time of recording in ns."""


class Ros:
    """Types of one generation of ROS, and a writer of its bags."""

    def __init__(self, container: str) -> None:
        systems = pytest.importorskip("rosbags.typesys")
        self.container = container
        first = container == "ros1"
        store = systems.Stores.ROS1_NOETIC if first else systems.Stores.ROS2_HUMBLE
        self.store = systems.get_typestore(store)
        self.first = first
        for name, text in TYPES.items():
            text = text.replace("builtin_interfaces/Time", "time") if first else text
            self.store.register(systems.get_types_from_msg(text, name))

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def time(self, t_ns: int) -> Any:
        return self.make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)

    def header(self, t_ns: int, frame: str = "camera") -> Any:
        sequence = {"seq": 0} if self.first else {}
        return self.make("std_msgs/msg/Header", stamp=self.time(t_ns), frame_id=frame, **sequence)

    def event_array(self, events: EventStream, frame: str = "camera") -> Any:
        columns = (events.x, events.y, events.t_us, events.p)
        stored = [
            self.make("dvs_msgs/msg/Event", x=x, y=y, ts=self.time(1000 * t), polarity=p > 0)
            for x, y, t, p in zip(*(column.tolist() for column in columns), strict=True)
        ]
        header = self.header(1000 * int(events.t_us[0]) if len(events) else 0, frame)
        return self.make(
            ARRAY, header=header, height=events.height, width=events.width, events=stored
        )

    def packet(
        self, encoding: str, payload: bytes, *, stamp_ns: int, base_ns: int = 0, size=(12, 10)
    ) -> Any:
        return self.make(
            PACKET,
            header=self.header(stamp_ns),
            height=size[1],
            width=size[0],
            seq=0,
            time_base=base_ns,
            encoding=encoding,
            is_bigendian=False,
            events=np.frombuffer(payload, np.uint8),
        )

    def image(self, encoding: str, data: np.ndarray, *, stamp_ns: int, padding: int = 0) -> Any:
        rows = np.ascontiguousarray(data).reshape(len(data), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        return self.make(
            IMAGE,
            header=self.header(stamp_ns),
            height=data.shape[0],
            width=data.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def write(self, folder: Path, sent: list[Sent], *, compression: str = "") -> Path:
        """A bag of these messages; where it is."""
        if self.first:
            path, writer = self._first(folder, compression)
        else:
            path, writer = self._second(folder, compression)
        with writer:
            connections: dict[str, Any] = {}
            for topic, kind, message, t_ns in sent:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], t_ns, self._bytes(message, kind))
        return path

    def _bytes(self, message: Any, kind: str) -> Any:
        if self.first:
            return self.store.serialize_ros1(message, kind)
        return self.store.serialize_cdr(message, kind)

    def _first(self, folder: Path, compression: str) -> tuple[Path, Any]:
        bags = pytest.importorskip("rosbags.rosbag1")
        writer = bags.Writer(folder / "a.bag")
        if compression:
            writer.set_compression(writer.CompressionFormat[compression.upper()])
        return folder / "a.bag", writer

    def _second(self, folder: Path, compression: str) -> tuple[Path, Any]:
        bags = pytest.importorskip("rosbags.rosbag2")
        plugin = bags.StoragePlugin[self.container.upper()]
        writer = bags.Writer(folder / "bag", version=9, storage_plugin=plugin)
        if compression:
            mode = bags.CompressionMode[compression.upper()]
            writer.set_compression(mode, bags.CompressionFormat.ZSTD)
        return folder / "bag", writer


def parts(events: EventStream, count: int) -> Iterator[EventStream]:
    """A stream in several messages."""
    edges = np.linspace(0, len(events), count + 1).astype(int)
    return (events[a:b] for a, b in zip(edges[:-1], edges[1:], strict=True))
