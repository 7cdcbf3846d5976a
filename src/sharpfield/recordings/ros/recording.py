"""Bags of ROS 1 and 2 (SQLite, MCAP): events of one topic, images of another.

Messages name their type; those of `recordings.event_messages` and `recordings.image_messages` are
understood. A bag with several such topics is a question to the user.

Which clock: all times are put on the clock of the header stamps, which events and images share.
Events of `dvs_msgs` and packets of `libcaer` are on it already: their driver has added when
it started to the sensor's clock. Prophesee's sensors (`evt3`, `mono`) count from when they
were switched on: the first event is set to the stamp of its packet, and all others keep their
distance from it, since stamps of packets say when these arrived and not when light changed.

Exposures: an image has one stamp, for when its shutter opened. A topic `<images>/exposure` of
`sensor_msgs/TimeReference`, where there is one, gives the end: its header has the stamp of an
image, and its reference is the end of the exposure of that image.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import Damaged, head
from sharpfield.recordings.chunks import joined, known_size
from sharpfield.recordings.format import NO_OPTIONS, Format, ReaderOptions
from sharpfield.recordings.prophesee.evt import ENCODINGS as EVT_ENCODINGS
from sharpfield.recordings.prophesee.evt import decoded, trigger_edges
from sharpfield.recordings.recording import Chunks, Frame, ReadLog, Recording, Triggers
from sharpfield.recordings.ros import libcaer, mcap
from sharpfield.recordings.ros import ros1 as ros1_bag
from sharpfield.recordings.ros import sqlite as sqlite_bag
from sharpfield.recordings.ros.bag import Bag, Fields, Message
from sharpfield.recordings.ros.event_messages import (
    ARRAYS,
    COMPRESSED,
    PACKETS,
    PLAIN,
    Image,
    Packet,
    event_arrays,
    event_packet,
    image,
    start,
)
from sharpfield.recordings.ros.mcap import open_mcap
from sharpfield.recordings.ros.ros1 import open_ros1_bag
from sharpfield.recordings.ros.sqlite import open_sqlite_bag

OPENERS = {
    ros1_bag.FIRST_LINE: open_ros1_bag,
    mcap.MAGIC: open_mcap,
    sqlite_bag.MAGIC: open_sqlite_bag,
}
"""By what a file begins with: bags that broke off have other names."""

EVENT_TYPES, IMAGE_TYPES = (*ARRAYS, *PACKETS), (PLAIN, COMPRESSED)
EXPOSURE_TYPE = "sensor_msgs/TimeReference"

SENSOR_CLOCKS = (*EVT_ENCODINGS, "mono")
"""Encodings whose times are those of the sensor."""

AHEAD = 64
"""Messages that are looked at to learn of the size, the encoding and the clock."""


@dataclass(frozen=True)
class Source:
    """Events of a bag."""

    bag: Bag
    topic: str
    size: tuple[int, int]
    encoding: str
    """Of packets; "" if events are plain."""
    shift_us: int
    """From the sensor's clock to that of the stamps."""


def open_rosbag(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a bag.

    Args:
        path: A `.bag`, `.mcap` or `.db3`, or the folder of a bag of ROS 2.
        options: `size`, where messages do not give it; `topic` of the events and `image_topic` of
            the images, where there are several such topics; an empty image topic for no images.

    Raises:
        CaptureError: It is no bag, holds neither events nor images, or several topics of either
            and none was chosen.
    """
    bag, trouble = _opened(path), ReadLog()
    events, image_topic = _chosen(bag, EVENT_TYPES, options.topic, "topic"), options.image_topic
    images = None if image_topic == "" else _chosen(bag, IMAGE_TYPES, image_topic, "image_topic")
    if events is None and images is None:
        raise CaptureError(
            "the bag holds neither events nor images", where=path, got=_listed(bag, bag.topics)
        )
    source = None if events is None else _source(bag, events, options.size)
    encoded = source is not None and source.encoding in EVT_ENCODINGS
    return Recording(
        path,
        bag.layout,
        options.size if source is None else source.size,
        events=None if source is None else partial(_events, source, trouble),
        frames=None if images is None else partial(_frames, bag, images, trouble),
        triggers=partial(_triggers, source) if source is not None and encoded else None,
        bayer="" if images is None else _bayer(bag, images),
        trouble=trouble,
        notes={name: kind for name, (kind, _) in bag.topics.items()},
    )


def _opened(path: Path) -> Bag:
    """The bag, be it a file, or a folder of files that follow each other."""
    if not path.is_dir():
        start = head(path, 16)
        for magic, open_file in OPENERS.items():
            if start.startswith(magic):
                return open_file(path)
        raise CaptureError(
            "the file is no bag",
            where=path,
            got=start,
            do="open a .bag of ROS 1, or a .db3 or .mcap of ROS 2",
        )
    paths = [file for file in path.iterdir() if file.suffix in (".mcap", ".db3")]
    if not paths or len({file.suffix for file in paths}) > 1:
        raise CaptureError(
            "the folder is no bag of ROS 2",
            where=path,
            got=", ".join(sorted(file.name for file in path.iterdir())[:8]) or "an empty folder",
            do="it should hold one or several .db3, or .mcap; unpack files in .zstd first",
        )
    return _chained(path, [_opened(file) for file in sorted(paths, key=_number)])


def _number(path: Path) -> tuple[int, str]:
    """Files of a bag are numbered: 10 comes after 9."""
    last = path.stem.rpartition("_")[2]
    return (int(last) if last.isascii() and last.isdigit() else -1, path.stem)


def _chained(path: Path, bags: list[Bag]) -> Bag:
    def messages(wanted: Collection[str], trouble: ReadLog) -> Iterator[Message]:
        return (message for bag in bags for message in bag.messages(wanted, trouble))

    topics = {name: topic for bag in bags for name, topic in bag.topics.items()}
    return Bag(path, bags[0].layout, topics, messages)


def _chosen(bag: Bag, kinds: tuple[str, ...], asked: str | None, option: str) -> str | None:
    """The topic that is meant, or None if there is none."""
    found = [name for name, topic in bag.topics.items() if topic.kind in kinds]
    if asked is not None and asked not in found:
        raise CaptureError(
            f"the bag has no topic {asked} of a known type",
            where=bag.path,
            got=_listed(bag, bag.topics),
            do=f"known types are {', '.join(kinds)}",
        )
    if asked is None and len(found) > 1:
        raise CaptureError(
            "the bag has several topics of events"
            if kinds is EVENT_TYPES
            else "the bag has several topics of images",
            where=bag.path,
            got=_listed(bag, found),
            do=f"choose one: {option}={found[0]}",
        )
    return asked or (found[0] if found else None)


def _listed(bag: Bag, names: Collection[str]) -> str:
    return ", ".join(f"{name} ({bag.topics[name].kind})" for name in names) or "no topics"


def _source(bag: Bag, topic: str, given: tuple[int, int] | None) -> Source:
    """What the first messages tell.

    Raises:
        CaptureError: They are encoded in an unknown way, or do not tell the size.
    """
    known, stated, encoding = bag.topics[topic], None, ""
    for message in islice(bag.messages([topic], ReadLog()), AHEAD):
        try:
            width, height = start(Fields(message, known)).size
            encoding = event_packet(message, known).encoding if known.kind in PACKETS else ""
        except Damaged:
            continue
        stated = (width, height) if width and height else None
        break
    if encoding not in ("", *EVT_ENCODINGS, *libcaer.ENCODINGS):
        raise CaptureError(
            "events are encoded in a way that cannot be read here",
            where=f"{bag.path}, {topic}",
            got=encoding,
            do=f"known are {', '.join((*EVT_ENCODINGS, *libcaer.ENCODINGS))}",
        )
    source = Source(bag, topic, known_size(stated, given, bag.path), encoding, shift_us=0)
    return replace(source, shift_us=_shift_us(source))


def _shift_us(source: Source) -> int:
    """How far the stamp of the first packet with events is from the first of these."""
    if source.encoding not in SENSOR_CLOCKS:
        return 0
    packets: list[Packet] = []
    for packet in islice(_packets(source, ReadLog()), AHEAD):
        packets.append(packet)
        # The times of a packet may need what came before it.
        first = next(_decoded(source, iter(packets), ReadLog()), None)
        if first is not None and len(first):
            return (packet.stamp_ns + 500) // 1000 - int(first.t_us[0])
    return 0


def _events(source: Source, trouble: ReadLog) -> Chunks:
    trouble = trouble.anew("events")
    if not source.encoding:
        messages = source.bag.messages([source.topic], trouble)
        pieces = event_arrays(messages, source.bag.topics[source.topic], trouble)
        return joined(pieces, source.size, where=source.bag.path, trouble=trouble)
    chunks = _decoded(source, _packets(source, trouble), trouble)
    return (replace(chunk, t_us=chunk.t_us + source.shift_us) for chunk in chunks)


def _decoded(source: Source, packets: Iterator[Packet], trouble: ReadLog) -> Chunks:
    """Events by the clock of the payload."""
    where, encoding = source.bag.path, source.encoding
    if encoding in EVT_ENCODINGS:
        payloads = (bytes(packet.payload) for packet in packets)
        return decoded(encoding, payloads, source.size, where=where, trouble=trouble)
    pieces = (libcaer.decode(encoding, packet.payload, packet.base_ns) for packet in packets)
    return joined(pieces, source.size, where=where, trouble=trouble)


def _triggers(source: Source) -> Triggers:
    payloads = (bytes(packet.payload) for packet in _packets(source, ReadLog()))
    found = trigger_edges(source.encoding, payloads, where=source.bag.path)
    return replace(found, t_us=found.t_us + source.shift_us)


def _packets(source: Source, trouble: ReadLog) -> Iterator[Packet]:
    topic = source.bag.topics[source.topic]
    for message in source.bag.messages([source.topic], trouble):
        try:
            packet = event_packet(message, topic)
        except Damaged:
            trouble.note("damaged messages")
            continue
        if packet.encoding == source.encoding:
            yield packet
        else:
            trouble.note("messages encoded otherwise than the first")


def _bayer(bag: Bag, topic: str) -> str:
    """The tile of the first image."""
    return next((found.bayer for found in _images(bag, topic, ReadLog())), "")


def _frames(bag: Bag, topic: str, trouble: ReadLog) -> Iterator[Frame]:
    trouble = trouble.anew("frames")
    ends = _exposure_ends(bag, f"{topic}/exposure", trouble)
    before = None
    for found in _images(bag, topic, trouble):
        opened = (found.stamp_ns + 500) // 1000
        if before is not None and opened < before:
            trouble.note("frames earlier than those before them")
            continue
        before = opened
        yield Frame(found.image, opened, max(opened, ends.get(opened, opened)))


def _images(bag: Bag, topic: str, trouble: ReadLog) -> Iterator[Image]:
    for message in bag.messages([topic], trouble):
        try:
            found = image(message, bag.topics[topic])
        except Damaged:
            trouble.note("damaged frames")
            continue
        yield found


def _exposure_ends(bag: Bag, topic: str, trouble: ReadLog) -> dict[int, int]:
    """When the exposure ended that began at a time; empty if the bag does not say."""
    ends: dict[int, int] = {}
    if topic not in bag.topics or bag.topics[topic].kind != EXPOSURE_TYPE:
        return ends
    for message in bag.messages([topic], trouble):
        try:
            fields = Fields(message, bag.topics[topic])
            opened_ns, closed_ns = fields.header_ns(), fields.stamp_ns()
        except Damaged:
            trouble.note("damaged messages")
            continue
        ends[(opened_ns + 500) // 1000] = (closed_ns + 500) // 1000
    return ends


def _recognise(path: Path, head: bytes) -> bool:
    return head.startswith(tuple(OPENERS)) or (path / "metadata.yaml").is_file()


FORMAT = Format(
    "rosbag",
    open_rosbag,
    holds="events, images, triggers",
    marks="a bag of ROS 1, or of ROS 2 (SQLite, MCAP)",
    recognise=_recognise,
    suffixes=(".bag", ".db3", ".mcap"),
    options=("size", "topic", "image_topic"),
)
