"""Real recordings, repeated with time going on until there are as many events as you like.

EVT2 and EVT3 are repeated word by word. EVT2.1, DAT and bags of ROS hold the events of the EVT2
recording; bags have messages of dvs_msgs of 32,768 events each.
"""

import importlib
import shutil
import struct
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.core.events import EventStream
from sharpfield.recordings.prophesee.evt import open_evt
from sharpfield.recordings.prophesee.header import read_header
from sharpfield.recordings.recording import Recording
from sharpfield.recordings.ros.event_messages import EVENT, PADDED_EVENT
from tests.recordings.ros.ros1_writer import write_ros1_bag

HEADER = "% {name}\n% format {name};height={height};width={width}\n% Version 2\n"
HEADER += "% Width {width}\n% Height {height}\n% end\n"

MESSAGE = 2**15
"""Events in a message."""

SINCE_US = 1_600_000_000_000_000
"""When bags of ROS begin; others begin when the camera did."""

MESSAGES = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events\n"
    ),
}
BAGS = {"MCAP": "mcap", "SQLITE3": "db3"}
"""What ROS 2 keeps messages in, and how their files are called."""


def tiled(path: Path, out: Path, copies: int, *, word: str, kind_at: int, unit_us: int) -> int:
    """Repeat the words of a recording, times going on; how many events there are."""
    events = open_evt(path).load()
    ticks = int(events.t_us[-1]) // unit_us - int(events.t_us[0]) // unit_us + 1
    start = read_header(path).length
    words = np.fromfile(path, word, offset=start)
    mask = (1 << kind_at) - 1
    high = words >> kind_at == 8
    with out.open("wb") as file:
        file.write(path.read_bytes()[:start])
        for copy in range(copies):
            later = words.copy()
            later[high] = (8 << kind_at) | ((words[high] & mask) + copy * ticks & mask)
            file.write(later.tobytes())
    return copies * len(events)


def repacked(events: EventStream, folder: Path, copies: int) -> None:
    """The same events as EVT2.1 and as DAT."""
    span_us = int(events.t_us[-1] - events.t_us[0]) // 64 * 64 + 64
    x, y, bright = events.x.astype(np.int64), events.y.astype(np.int64), events.p > 0
    group = np.stack([events.t_us, y, bright, x >> 5])
    fresh = (np.diff(group, prepend=-1).any(0)) | (np.diff(x, prepend=0) <= 0)
    first = np.flatnonzero(fresh)
    masks = np.bitwise_or.reduceat(1 << (x & 31), first).astype(np.uint64)
    header = {"width": events.width, "height": events.height}
    with (folder / "EVT2.1.raw").open("wb") as packed, (folder / "DAT.dat").open("wb") as flat:
        packed.write(HEADER.format(name="EVT21", **header).encode())
        flat.write(HEADER.format(name="DAT", **header).encode().replace(b"% end\n", b"\x0c\x08"))
        for copy in range(copies):
            t = events.t_us + copy * span_us
            place = bright.astype(np.int64) << 28 | y << 14 | x
            flat.write(np.stack([t, place], -1).astype("<u4").tobytes())
            word = bright * 1 << 28 | (t & 63) << 22 | x >> 5 << 16 | y
            words = word[first].astype(np.uint64) << np.uint64(32) | masks
            high = (t[first] >> 6 | 8 << 28).astype(np.uint64) << np.uint64(32)
            new = np.flatnonzero(np.diff(high.astype(np.int64), prepend=0))
            packed.write(np.insert(words, new, high[new]).astype("<u8").tobytes())


def bags(events: EventStream, folder: Path, copies: int) -> None:
    """The same events as bags of ROS 1 and 2."""
    span_us = int(events.t_us[-1] - events.t_us[0]) + 1

    def chunks() -> Iterator[EventStream]:
        for copy in range(copies):
            yield replace(events, t_us=events.t_us + copy * span_us + SINCE_US)

    size = events.width, events.height
    write_ros1_bag(folder / "ROS1.bag", Recording(folder, "tiled", size, events=chunks))
    systems: Any = importlib.import_module("rosbags.typesys")
    types = systems.get_typestore(systems.Stores.ROS2_HUMBLE)
    for name, text in MESSAGES.items():
        types.register(systems.get_types_from_msg(text, name))
    writers: Any = importlib.import_module("rosbags.rosbag2")
    for name, suffix in BAGS.items():
        kind, bag = writers.StoragePlugin[name], folder / name
        with writers.Writer(bag, version=9, storage_plugin=kind) as writer:
            topic = writer.add_connection("/dvs/events", [*MESSAGES][-1], typestore=types)
            for chunk in chunks():
                for first in range(0, len(chunk), MESSAGE):
                    part = chunk[first : first + MESSAGE]
                    writer.write(topic, 1000 * int(part.t_us[-1]), aligned(part))
        (bag / f"{name}.{suffix}").rename(folder / f"ROS2.{suffix}")
        shutil.rmtree(bag)


def aligned(part: EventStream) -> bytes:
    """A message of dvs_msgs as in ROS 2, where each event but the first is padded in front."""
    seconds, microseconds = np.divmod(part.t_us, 10**6)
    columns = (part.x, part.y, seconds, 1000 * microseconds, part.p > 0)
    first, rest = np.empty(1, EVENT), np.zeros(len(part) - 1, PADDED_EVENT)
    for name, column in zip(EVENT.names or (), columns, strict=True):
        first[name], rest[name] = column[:1], column[1:]
    start = b"\0\1\0\0" + struct.pack("<IIIx3x", int(seconds[-1]), 0, 1)
    start += struct.pack("<III", part.height, part.width, len(part))
    return start + first.tobytes() + rest.tobytes()


def make(samples: Path, folder: Path, millions: float) -> None:
    """The files to read, and short ones like them."""
    for prefix, count in (("short-", 0.0), ("", 1e6 * millions)):
        with tempfile.TemporaryDirectory(dir=folder) as name:
            apart = Path(name)
            events = open_evt(samples / "evt2_sample.raw").load()
            copies = int(count / len(events)) + 1
            repacked(events, apart, copies)
            bags(events, apart, copies)
            sample, out = samples / "evt2_sample.raw", apart / "EVT2.raw"
            tiled(sample, out, copies, word="<u4", kind_at=28, unit_us=64)
            sample, out = samples / "evt3_sample.raw", apart / "EVT3.raw"
            tiled(sample, out, int(count / 219_596) + 1, word="<u2", kind_at=12, unit_us=4096)
            for path in apart.iterdir():
                path.rename(folder / f"{prefix}{path.name}")
