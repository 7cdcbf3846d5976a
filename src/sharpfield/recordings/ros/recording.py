"""Bags of ROS 1 and 2 (SQLite, MCAP): events of one topic, images of another.

The message types of `event_messages` are read. Where a bag has several topics of such a type, the
caller has to choose one.

Clock: all times are on the clock of the header stamps, which events and images share. Events of
`dvs_msgs` and packets of `libcaer` are on it already: their driver adds its start time to the
sensor's clock. Prophesee's sensors (`evt3`, `mono`) count from power-on: the first event is set to
the stamp of its packet, and all others keep their distance from it, since stamps of packets give
the time of arrival and not of the change of light.

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
from sharpfield.recordings.bytes import DamagedData, read_head
from sharpfield.recordings.chunks import merge_chunks, resolve_size
from sharpfield.recordings.prophesee.evt import ENCODINGS as EVT_ENCODINGS
from sharpfield.recordings.prophesee.evt import decode_chunks, decode_triggers
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    Frame,
    ReaderOptions,
    ReadLog,
    Recording,
    Triggers,
)
from sharpfield.recordings.ros.bag import ROS1_LINE, Bag, FieldReader, Message, open_ros1_bag
from sharpfield.recordings.ros.event_messages import (
    ARRAYS,
    COMPRESSED,
    LIBCAER_ENCODINGS,
    PACKETS,
    PLAIN,
    Packet,
    StampedImage,
    decode_image,
    decode_libcaer,
    event_arrays,
    event_header,
    event_packet,
)
from sharpfield.recordings.ros.ros2 import MCAP_MAGIC, SQLITE_MAGIC, open_mcap, open_sqlite_bag

OPENERS = {ROS1_LINE: open_ros1_bag, MCAP_MAGIC: open_mcap, SQLITE_MAGIC: open_sqlite_bag}
"""Functions to open a bag by its signature; the suffix does not decide, as unfinished bags have
another."""

EVENT_TYPES, IMAGE_TYPES = (*ARRAYS, *PACKETS), (PLAIN, COMPRESSED)
EXPOSURE_TYPE = "sensor_msgs/TimeReference"

SENSOR_CLOCKS = (*EVT_ENCODINGS, "mono")
"""Encodings whose times count from power-on of the sensor."""

FIRST_MESSAGES = 64
"""Messages from which resolution, encoding and clock are found."""


@dataclass(frozen=True)
class EventSource:
    """Events of one topic of a bag."""

    bag: Bag
    topic: str
    size: tuple[int, int]
    encoding: str
    """Encoding of the packets; "" for event arrays."""
    shift_us: int
    """Offset from the sensor's clock to that of the stamps."""


def open_rosbag(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a bag.

    Args:
        path: A `.bag`, `.mcap` or `.db3`, or the folder of a bag of ROS 2.
        options: `size`, where messages do not give it; `topic` of the events and `image_topic` of
            the images, where there are several such topics; an empty image topic for no images.

    Raises:
        CaptureError: The file is no bag, holds neither events nor images, or has several topics of
            either and none was chosen.
    """
    bag, log = _opened(path), ReadLog()
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
        events=None if source is None else partial(_events, source, log),
        frames=None if images is None else partial(_frames, bag, images, log),
        triggers=partial(_triggers, source) if source is not None and encoded else None,
        bayer=""
        if images is None
        else next((x.bayer for x in _images(bag, images, ReadLog())), ""),
        log=log,
        notes={name: kind for name, (kind, _) in bag.topics.items()},
    )


def _opened(path: Path) -> Bag:
    """Open a bag: one file, or a folder of consecutive files."""
    if not path.is_dir():
        start = read_head(path, 16)
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
    return _concatenated(path, [_opened(file) for file in sorted(paths, key=_number)])


def _number(path: Path) -> tuple[int, str]:
    """Sort key of the files of a bag, which are numbered: 10 comes after 9."""
    last = path.stem.rpartition("_")[2]
    return (int(last) if last.isascii() and last.isdigit() else -1, path.stem)


def _concatenated(path: Path, bags: list[Bag]) -> Bag:
    def messages(wanted: Collection[str], log: ReadLog) -> Iterator[Message]:
        return (message for bag in bags for message in bag.messages(wanted, log))

    topics = {name: topic for bag in bags for name, topic in bag.topics.items()}
    return Bag(path, bags[0].layout, topics, messages)


def _chosen(bag: Bag, kinds: tuple[str, ...], chosen: str | None, option: str) -> str | None:
    """Name of the chosen topic; None if the bag has no topic of these types."""
    found = [name for name, topic in bag.topics.items() if topic.kind in kinds]
    if chosen is not None and chosen not in found:
        raise CaptureError(
            f"the bag has no topic {chosen} of a known type",
            where=bag.path,
            got=_listed(bag, bag.topics),
            do=f"known types are {', '.join(kinds)}",
        )
    if chosen is None and len(found) > 1:
        raise CaptureError(
            "the bag has several topics of events"
            if kinds is EVENT_TYPES
            else "the bag has several topics of images",
            where=bag.path,
            got=_listed(bag, found),
            do=f"choose one: {option}={found[0]}",
        )
    return chosen or (found[0] if found else None)


def _listed(bag: Bag, names: Collection[str]) -> str:
    return ", ".join(f"{name} ({bag.topics[name].kind})" for name in names) or "no topics"


def _source(bag: Bag, topic: str, given: tuple[int, int] | None) -> EventSource:
    """Resolution, encoding and clock of a topic, from its first messages.

    Raises:
        CaptureError: The encoding or the resolution is unknown.
    """
    known, stated, encoding = bag.topics[topic], None, ""
    for message in islice(bag.messages([topic], ReadLog()), FIRST_MESSAGES):
        try:
            _, (width, height) = event_header(FieldReader(message, known))
            encoding = event_packet(message, known).encoding if known.kind in PACKETS else ""
        except DamagedData:
            continue
        stated = (width, height) if width and height else None
        break
    if encoding not in ("", *EVT_ENCODINGS, *LIBCAER_ENCODINGS):
        raise CaptureError(
            "events are encoded in a way that cannot be read here",
            where=f"{bag.path}, {topic}",
            got=encoding,
            do=f"known are {', '.join((*EVT_ENCODINGS, *LIBCAER_ENCODINGS))}",
        )
    source = EventSource(bag, topic, resolve_size(stated, given, bag.path), encoding, shift_us=0)
    return replace(source, shift_us=_shift_us(source))


def _shift_us(source: EventSource) -> int:
    """Stamp of the first packet with events, minus the time of its first event."""
    if source.encoding not in SENSOR_CLOCKS:
        return 0
    packets: list[Packet] = []
    for packet in islice(_packets(source, ReadLog()), FIRST_MESSAGES):
        packets.append(packet)
        # Decoding the times of a packet may need the packets before it.
        first = next(_decoded(source, iter(packets), ReadLog()), None)
        if first is not None and len(first):
            return (packet.stamp_ns + 500) // 1000 - int(first.t_us[0])
    return 0


def _events(source: EventSource, log: ReadLog) -> Chunks:
    log = log.start("events")
    if not source.encoding:
        messages = source.bag.messages([source.topic], log)
        raw_chunks = event_arrays(messages, source.bag.topics[source.topic], log)
        return merge_chunks(raw_chunks, source.size, where=source.bag.path, log=log)
    chunks = _decoded(source, _packets(source, log), log)
    return (replace(chunk, t_us=chunk.t_us + source.shift_us) for chunk in chunks)


def _decoded(source: EventSource, packets: Iterator[Packet], log: ReadLog) -> Chunks:
    """Decode packets; times are on the clock of the payload."""
    where, encoding = source.bag.path, source.encoding
    if encoding in EVT_ENCODINGS:
        payloads = (bytes(packet.payload) for packet in packets)
        return decode_chunks(encoding, payloads, source.size, where=where, log=log)
    raw_chunks = (decode_libcaer(encoding, packet.payload, packet.base_ns) for packet in packets)
    return merge_chunks(raw_chunks, source.size, where=where, log=log)


def _triggers(source: EventSource) -> Triggers:
    payloads = (bytes(packet.payload) for packet in _packets(source, ReadLog()))
    found = decode_triggers(source.encoding, payloads, where=source.bag.path)
    return replace(found, t_us=found.t_us + source.shift_us)


def _packets(source: EventSource, log: ReadLog) -> Iterator[Packet]:
    topic = source.bag.topics[source.topic]
    for message in source.bag.messages([source.topic], log):
        try:
            packet = event_packet(message, topic)
        except DamagedData:
            log.note("damaged messages")
            continue
        if packet.encoding == source.encoding:
            yield packet
        else:
            log.note("messages encoded otherwise than the first")


def _frames(bag: Bag, topic: str, log: ReadLog) -> Iterator[Frame]:
    log = log.start("frames")
    ends = _exposure_ends(bag, f"{topic}/exposure", log)
    before = None
    for found in _images(bag, topic, log):
        opened = (found.stamp_ns + 500) // 1000
        if before is not None and opened < before:
            log.note("frames earlier than those before them")
            continue
        before = opened
        yield Frame(found.image, opened, max(opened, ends.get(opened, opened)))


def _images(bag: Bag, topic: str, log: ReadLog) -> Iterator[StampedImage]:
    for message in bag.messages([topic], log):
        try:
            found = decode_image(message, bag.topics[topic])
        except DamagedData:
            log.note("damaged frames")
            continue
        yield found


def _exposure_ends(bag: Bag, topic: str, log: ReadLog) -> dict[int, int]:
    """End of each exposure by its start, in us; empty if the bag has no such topic."""
    ends: dict[int, int] = {}
    if topic not in bag.topics or bag.topics[topic].kind != EXPOSURE_TYPE:
        return ends
    for message in bag.messages([topic], log):
        try:
            fields = FieldReader(message, bag.topics[topic])
            opened_ns, closed_ns = fields.header_ns(), fields.stamp_ns()
        except DamagedData:
            log.note("damaged messages")
            continue
        ends[(opened_ns + 500) // 1000] = (closed_ns + 500) // 1000
    return ends


FORMAT = Format(
    "rosbag",
    open_rosbag,
    holds="events, images, triggers",
    marks="a bag of ROS 1, or of ROS 2 (SQLite, MCAP)",
    recognise=lambda path, head: (
        head.startswith(tuple(OPENERS)) or (path / "metadata.yaml").is_file()
    ),
    suffixes=(".bag", ".db3", ".mcap"),
    options=("size", "topic", "image_topic"),
)
