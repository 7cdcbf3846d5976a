import struct
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Frame, ReaderOptions, Recording
from sharpfield.recordings.ros.recording import open_rosbag
from tests.recordings import fuzz
from tests.recordings.bags import ARRAY, COMPRESSED, IMAGE, PACKET, Ros, parts
from tests.recordings.captured import (
    START_US,
    expect_equal_events,
    expect_equal_frames,
    some_frames,
    some_recording,
)
from tests.recordings.prophesee.test_evt import random_evt3
from tests.recordings.ros.ros1_writer import write_ros1_bag
from tests.streams import HEIGHT, WIDTH, random_events

CONTAINERS = ["ros1", "sqlite3", "mcap"]


def late_events(count: int, seed: int = 0) -> EventStream:
    events = random_events(count, seed=seed)
    return replace(events, t_us=events.t_us + START_US)


def arrays(ros: Ros, events: EventStream, topic: str = "/dvs/events", messages: int = 4) -> list:
    return [
        (topic, ARRAY, ros.event_array(part), 1000 * int(part.t_us[-1]))
        for part in parts(events, messages)
    ]


# --- what is written is read


@pytest.mark.parametrize("colours", [(), (3,)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_what_is_written_is_read(tmp_path: Path, colours, kind) -> None:
    pytest.importorskip("rosbags")
    recording = some_recording(3000, some_frames(colours=colours, kind=kind))
    if colours and kind is np.uint16:
        recording = replace(recording, frames=None)
    write_ros1_bag(tmp_path / "a.bag", recording)
    read = open_rosbag(tmp_path / "a.bag")
    assert (read.layout, read.size) == ("ROS1 bag", (WIDTH, HEIGHT))
    expect_equal_events(read.load(), recording.load())
    if recording.frames:
        expect_equal_frames(list(read.frames()), list(recording.frames()))
    assert not str(read.log)


def test_raw_colour_keeps_its_tile(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    recording = replace(some_recording(10), bayer="GBRG")
    write_ros1_bag(tmp_path / "a.bag", recording)
    read = open_rosbag(tmp_path / "a.bag")
    assert read.bayer == "GBRG"
    expect_equal_frames(list(read.frames()), list(recording.frames()))


def test_another_library_reads_what_is_written(tmp_path: Path) -> None:
    bags = pytest.importorskip("rosbags.rosbag1")
    ros = Ros("ros1")
    recording = some_recording(300)
    write_ros1_bag(tmp_path / "a.bag", recording, name="/davis")
    found, images, logged = [], [], []
    with bags.Reader(tmp_path / "a.bag") as reader:
        digests = {connection.topic: connection.digest for connection in reader.connections}
        for connection, t_ns, data in reader.messages():
            logged.append(t_ns)
            message = ros.store.deserialize_ros1(data, connection.msgtype)
            if connection.topic == "/davis/events":
                found += message.events
            elif connection.topic == "/davis/image_raw":
                images.append(message)
    assert digests["/davis/events"] == "5e8beee5a6c107e504c2e78903c224b8"
    assert logged == sorted(logged)
    events = recording.load()
    assert [event.x for event in found] == events.x.tolist()
    times = [event.ts.sec * 10**6 + event.ts.nanosec // 1000 for event in found]
    assert times == events.t_us.tolist()
    frame = next(recording.frames())
    assert (images[0].encoding, images[0].step) == ("mono8", WIDTH)
    np.testing.assert_array_equal(images[0].data.reshape(HEIGHT, WIDTH), frame.image)


# --- what another library writes is read


@pytest.mark.parametrize("container", CONTAINERS)
def test_events_of_dvs_msgs(tmp_path: Path, container: str) -> None:
    ros = Ros(container)
    events = late_events(500)
    for frame in ("", "a", "ab", "abc", "abcd"):
        sent = [
            ("/events", ARRAY, ros.event_array(part, frame), 1000 * int(part.t_us[0]))
            for part in parts(events, 3)
        ]
        folder = tmp_path / f"folder-{frame}"
        folder.mkdir()
        read = open_rosbag(ros.write(folder, sent))
        expect_equal_events(read.load(), events)
        assert not str(read.log) and read.frames is None and read.triggers is None


@pytest.mark.parametrize(
    ("container", "compression"),
    [("ros1", "bz2"), ("ros1", "lz4"), ("sqlite3", "message"), ("mcap", "storage")],
)
def test_compressed_bags(tmp_path: Path, container: str, compression: str) -> None:
    ros, events = Ros(container), late_events(500)
    path = ros.write(tmp_path, arrays(ros, events), compression=compression)
    expect_equal_events(open_rosbag(path).load(), events)


def test_an_empty_message_and_one_event(tmp_path: Path) -> None:
    for container in CONTAINERS:
        ros, events = Ros(container), late_events(1)
        sent = [
            ("/events", ARRAY, ros.event_array(part), 1)
            for part in (events[:0], events, events[:0])
        ]
        folder = tmp_path / container
        folder.mkdir()
        expect_equal_events(open_rosbag(ros.write(folder, sent)).load(), events)


@pytest.mark.parametrize("container", CONTAINERS)
def test_images(tmp_path: Path, container: str) -> None:
    ros = Ros(container)
    draw = np.random.default_rng(0)
    grey = draw.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8)
    deep = draw.integers(0, 2**16, (HEIGHT, WIDTH)).astype(np.uint16)
    colour = draw.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    stored = [("mono8", grey), ("mono16", deep), ("rgb8", colour), ("bgr8", colour[..., ::-1])]
    sent = [
        ("/images", IMAGE, ros.image(name, data, stamp_ns=10**9 + i, padding=5), i)
        for i, (name, data) in enumerate(stored)
    ]
    read = open_rosbag(ros.write(tmp_path, sent))
    frames = list(read.frames())
    for frame, expected in zip(frames, [grey, deep, colour, colour], strict=True):
        np.testing.assert_array_equal(frame.image, expected)
        assert (frame.open_us, frame.close_us) == (10**6, 10**6)
    assert read.events is None and not str(read.log)


def test_images_packed_as_png(tmp_path: Path) -> None:
    ros = Ros("mcap")
    colour = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    packed = cv2.imencode(".png", colour[..., ::-1])[1].reshape(-1)

    def message(data: np.ndarray) -> object:
        return ros.make(COMPRESSED, header=ros.header(5000), format="png", data=data)

    sent = [("/a/compressed", COMPRESSED, message(data), 1) for data in (packed, packed[:9])]
    read = open_rosbag(ros.write(tmp_path, sent))
    frames = list(read.frames())
    assert len(frames) == 1 and (frames[0].open_us, frames[0].close_us) == (5, 5)
    np.testing.assert_array_equal(frames[0].image, colour)
    assert read.log.counts == {"damaged frames": 1}


# --- packets of event_camera_msgs


def test_mono(tmp_path: Path) -> None:
    """The sensor counts from when it was switched on; stamps are of the computer."""
    ros, events = Ros("ros1"), random_events(400)
    stamp_ns = 1000 * START_US
    sent = []
    for part in parts(events, 3):
        base_ns = 1000 * int(part.t_us[0]) - 400
        payload = b"".join(
            struct.pack("<IHH", 1000 * t - base_ns, x, y | (p > 0) << 15)
            for t, x, y, p in zip(part.t_us, part.x.tolist(), part.y.tolist(), part.p, strict=True)
        )
        message = ros.packet("mono", payload, stamp_ns=stamp_ns, base_ns=base_ns)
        sent.append(("/events", PACKET, message, stamp_ns))
    read = open_rosbag(ros.write(tmp_path, sent))
    shifted = replace(events, t_us=events.t_us - events.t_us[0] + START_US)
    expect_equal_events(read.load(), shifted)


def test_libcaer(tmp_path: Path) -> None:
    """Times of 31 bits, which wrap within a packet."""
    ros, events = Ros("mcap"), random_events(400)
    since = 2**31 - 45_000
    payload = b"".join(
        struct.pack("<II", x << 17 | y << 2 | (p > 0) << 1 | 1, (since + t) & 0x7FFFFFFF)
        for t, x, y, p in zip(
            events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.p, strict=True
        )
    )
    message = ros.packet("libcaer", payload, stamp_ns=7, base_ns=1000 * START_US)
    read = open_rosbag(ros.write(tmp_path, [("/events", PACKET, message, 7)]))
    expect_equal_events(read.load(), replace(events, t_us=events.t_us + START_US + since))


def slowly(payload: bytes, base_us: int) -> list[tuple[int, int, int, int]]:
    """Events of `libcaer_cmp`, word by word."""
    found, high, low, x, base, sign = [], 0, 0, 0, 0, 0
    for (word,) in struct.iter_unpack("<H", payload):
        kind, value = word >> 12, word & 0xFFF
        if kind == 0:
            high = value * 4096
        if kind == 1:
            low = value
        if kind == 2:
            x = value % 2048
        if kind == 3:
            found.append((base_us + high + low, x, value % 2048, 1 if value >= 2048 else -1))
        if kind == 4:
            base, sign = value % 2048, 1 if value >= 2048 else -1
        if kind == 5:
            for bit in range(8):
                if value >> bit & 1:
                    found.append((base_us + high + low, x, base + bit, sign))
            base += 8
    return found


def test_libcaer_cmp(tmp_path: Path) -> None:
    words = [
        *(0x0001, 0x1005, 0x2003, 0x3804, 0x3002, 0x4801, 0x5081, 0x1006, 0x2002, 0x5003),
        *(0x0002, 0x3001),
    ]
    payload = struct.pack(f"<{len(words)}H", *words)
    ros = Ros("mcap")
    message = ros.packet("libcaer_cmp", payload, stamp_ns=7, base_ns=1000 * START_US)
    events = open_rosbag(ros.write(tmp_path, [("/e", PACKET, message, 7)])).load()
    expected = [
        (0x1005, 3, 4, 1),
        (0x1005, 3, 2, -1),
        (0x1005, 3, 1, 1),
        (0x1005, 3, 8, 1),
        (0x1006, 2, 9, 1),
        (0x2006, 2, 1, -1),
    ]
    rows = zip(events.t_us - START_US, events.x, events.y, events.p, strict=True)
    assert [tuple(int(value) for value in row) for row in rows] == expected
    assert [(t - START_US, *rest) for t, *rest in slowly(payload, START_US)] != expected
    assert slowly(payload, 0)[:4] == expected[:4]


def test_the_first_event_is_set_to_the_stamp_of_its_packet(tmp_path: Path) -> None:
    """EVT3: a packet of times alone, then two events at 4096 + 7 us and a trigger."""
    ros = Ros("mcap")
    payloads = [[0x8001, 0x6001, 0x8001, 0x6002], [0x6007, 0x0005, 0x2803, 0x2004, 0x6009, 0xA001]]
    sent = [
        (
            "/events",
            PACKET,
            ros.packet(
                "evt3", struct.pack(f"<{len(words)}H", *words), stamp_ns=(START_US + 500 * i) * 1000
            ),
            i,
        )
        for i, words in enumerate(payloads)
    ]
    read = open_rosbag(ros.write(tmp_path, sent))
    events = read.load()
    assert events.t_us.tolist() == [START_US + 500] * 2
    assert (events.x.tolist(), events.y.tolist(), events.p.tolist()) == ([3, 4], [5, 5], [1, -1])
    assert read.triggers().t_us.tolist() == [START_US + 502]


# --- real recordings


@pytest.mark.parametrize("name", ["test_events_1.bag", "test_events_1"])
def test_real_recordings_of_evt3(samples: Path, name: str) -> None:
    read = open_rosbag(samples / "ros" / name)
    events = read.load()
    assert (read.size, len(events)) == ((640, 480), 343_474)
    assert events.t_us[-1] - events.t_us[0] == 2_078_178
    assert events.t_us[0] == 1_675_956_550_318_679
    assert (events.p > 0).sum() == 125_183
    assert not str(read.log)
    assert len(read.triggers().t_us) == 4157


def test_the_real_recording_of_libcaer_cmp(samples: Path) -> None:
    path = samples / "ros" / "test_events_2"
    events = open_rosbag(path).load()
    assert (events.width, events.height, len(events)) == (346, 260, 571_266)
    assert events.t_us[-1] - events.t_us[0] == 999_996
    mcap = pytest.importorskip("mcap.reader")
    packets = []
    with next(path.glob("*.mcap")).open("rb") as file:
        for _, _, message in mcap.make_reader(file).iter_messages():
            packets.append(message.data)
    assert len(packets) == 100
    expected = []
    for data in packets[:3]:
        # CDR: header with a name, two sizes, two numbers of 64 bits, the encoding, a flag.
        place = data.index(b"libcaer_cmp\0")
        (base_ns,) = struct.unpack_from("<Q", data, place - 12)
        at = place + 12 + 1
        at += -(at - 4) % 4
        (size,) = struct.unpack_from("<I", data, at)
        expected += slowly(data[at + 4 : at + 4 + size], base_ns // 1000)
    found = events[: len(expected)]
    rows = zip(found.t_us, found.x, found.y, found.p, strict=True)
    assert [tuple(int(value) for value in row) for row in rows] == expected


# --- edges and errors


def test_torn_bags_are_read_as_far_as_they_go(tmp_path: Path) -> None:
    events = late_events(2000)
    for container in ("ros1", "mcap"):
        ros = Ros(container)
        folder = tmp_path / container
        folder.mkdir()
        path = ros.write(folder, arrays(ros, events, messages=40))
        file = path if path.is_file() else next(path.glob("*.mcap"))
        if container == "ros1":
            # Its chunks are large: put the end of the only one into the truncated part.
            file.write_bytes(file.read_bytes()[:-100])
        else:
            file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
        read = open_rosbag(path)
        found = read.load()
        assert 1000 < len(found) <= 2000
        expect_equal_events(found, events[: len(found)])
        assert "truncated ends of the file" in read.log.counts


def test_a_bag_is_known_by_what_it_begins_with(tmp_path: Path) -> None:
    ros, events = Ros("ros1"), late_events(100)
    path = ros.write(tmp_path, arrays(ros, events))
    expect_equal_events(open_rosbag(path.rename(tmp_path / "a.bag.active")).load(), events)


def test_files_of_a_bag_follow_each_other_by_number(tmp_path: Path) -> None:
    ros, events = Ros("mcap"), late_events(330)
    folder = tmp_path / "whole"
    folder.mkdir()
    for i, part in enumerate(parts(events, 11)):
        one = tmp_path / str(i)
        one.mkdir()
        path = ros.write(one, arrays(ros, part, messages=1))
        next(path.glob("*.mcap")).rename(folder / f"bag_{i}.mcap")
    expect_equal_events(open_rosbag(folder).load(), events)


def test_damaged_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    ros, events = Ros("ros1"), late_events(400)
    sent = arrays(ros, events)
    store = ros.store.serialize_ros1

    def truncated(message: object, kind: str) -> bytes:
        data = bytes(store(message, kind))
        return data[:-1] if message is sent[1][2] else data

    ros.store.serialize_ros1 = truncated
    read = open_rosbag(ros.write(tmp_path, sent))
    assert len(read.load()) == 300
    assert read.log.counts == {"damaged messages": 1}


def test_one_of_several_topics_is_chosen(tmp_path: Path) -> None:
    ros, left, right = Ros("mcap"), late_events(100), late_events(80, seed=1)
    image = ros.image("mono8", np.zeros((HEIGHT, WIDTH), np.uint8), stamp_ns=1)
    path = ros.write(
        tmp_path,
        [
            *arrays(ros, left, "/left/events"),
            *arrays(ros, right, "/right/events"),
            ("/left/image_raw", IMAGE, image, 1),
            ("/right/image_raw", IMAGE, image, 1),
        ],
    )
    with pytest.raises(CaptureError) as refused:
        open_rosbag(path)
    assert str(refused.value) == (
        "CaptureError: the bag has several topics of events\n"
        f"  where  {path}\n"
        "  got    /left/events (dvs_msgs/EventArray), /right/events (dvs_msgs/EventArray)\n"
        "  do     choose one: topic=/left/events"
    )
    with pytest.raises(CaptureError, match="several topics of images"):
        open_rosbag(path, ReaderOptions(topic="/left/events"))
    read = open_rosbag(path, ReaderOptions(topic="/right/events", image_topic="/left/image_raw"))
    expect_equal_events(read.load(), right)
    assert len(list(read.frames())) == 1
    assert open_rosbag(path, ReaderOptions(topic="/left/events", image_topic="")).frames is None
    with pytest.raises(CaptureError, match="the bag has no topic /middle of a known type"):
        open_rosbag(path, ReaderOptions(topic="/middle"))


def test_unknown_encodings_are_refused(tmp_path: Path) -> None:
    ros = Ros("mcap")
    message = ros.packet("holograms", b"", stamp_ns=1)
    path = ros.write(tmp_path, [("/events", PACKET, message, 1)])
    with pytest.raises(CaptureError, match="encoded in a way that cannot be read here"):
        open_rosbag(path)


def test_a_bag_without_anything_to_read(tmp_path: Path) -> None:
    ros = Ros("sqlite3")
    time = ros.make("std_msgs/msg/Header", stamp=ros.time(5), frame_id="")
    path = ros.write(tmp_path, [("/clock", "std_msgs/msg/Header", time, 1)])
    with pytest.raises(CaptureError, match="holds neither events nor images"):
        open_rosbag(path)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.txt"])
def test_other_files_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"#ROSBAG V1.2\n")
    with pytest.raises(CaptureError, match="the file is no"):
        open_rosbag(tmp_path / name)
    with pytest.raises(CaptureError, match="the folder is no bag of ROS 2"):
        (tmp_path / "empty").mkdir()
        open_rosbag(tmp_path / "empty")


@pytest.mark.parametrize("time_us", [-5, 2**32 * 10**6])
def test_times_that_ros_cannot_tell_are_refused(tmp_path: Path, time_us: int) -> None:
    pytest.importorskip("rosbags")
    frame = Frame(np.zeros((4, 4), np.uint8), time_us, time_us)
    recording = Recording(Path("a"), "test", frames=lambda: iter([frame]))
    with pytest.raises(CaptureError, match="times in bags of ROS lie between 1970 and 2106"):
        write_ros1_bag(tmp_path / "a.bag", recording)
    assert not list(tmp_path.iterdir())


# --- damage


def original(container: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ros, events = Ros(container), late_events(150)
        image = ros.image("mono8", np.zeros((HEIGHT, WIDTH), np.uint8), stamp_ns=1)
        sent = [*arrays(ros, events), ("/image_raw", IMAGE, image, 1)]
        path = ros.write(folder, sent)
        file = path if path.is_file() else next(path.glob(f"*.{SUFFIXES[container]}"))
        return file.read_bytes()


SUFFIXES = {"ros1": "bag", "sqlite3": "db3", "mcap": "mcap"}
for container in CONTAINERS:
    fuzz.register(
        f"rosbag-{container}",
        fuzz.Case(
            lambda container=container: original(container),
            open_rosbag,
            f".{SUFFIXES[container]}",
            most_per_byte=1.0,
        ),
    )


def packed_events(encoding: str, compression: str) -> bytes:
    """A bag of ROS 1 with packets, whose chunks are compressed."""
    if encoding == "evt3":
        payloads = [random_evt3(400)[i : i + 200] for i in range(0, 800, 200)]
    else:
        words = [(0x1000 | i, 0x2003, 0x3804, 0x4800, 0x5081) for i in range(20)]
        payloads = [np.array(words, "<u2").tobytes()] * 4
    with tempfile.TemporaryDirectory() as name:
        ros, sent = Ros("ros1"), []
        for i, payload in enumerate(payloads):
            base_ns = 10**8 * i
            message = ros.packet(encoding, payload, stamp_ns=i, base_ns=base_ns, size=(1280, 720))
            sent.append(("/e", PACKET, message, i + 1))
        return ros.write(Path(name), sent, compression=compression).read_bytes()


# Packed, a byte of LZ4 stands for up to 255.
PACKED = {"evt3": ("", 12.0), "libcaer_cmp": ("lz4", 1100.0)}
for encoding, (compression, most) in PACKED.items():
    fuzz.register(
        f"rosbag-{encoding}",
        fuzz.Case(
            lambda encoding=encoding, compression=compression: packed_events(encoding, compression),
            open_rosbag,
            ".bag",
            most_per_byte=most,
        ),
    )


@pytest.mark.parametrize("encoding", PACKED)
def test_damaged_packets(tmp_path: Path, encoding: str) -> None:
    pytest.importorskip("rosbags")
    outcomes = fuzz.campaign(f"rosbag-{encoding}", files=80, folder=tmp_path)
    assert outcomes["refused"] and outcomes["partial"]


@pytest.mark.parametrize("container", CONTAINERS)
def test_damaged_files(tmp_path: Path, container: str) -> None:
    pytest.importorskip("rosbags")
    outcomes = fuzz.campaign(f"rosbag-{container}", files=80, folder=tmp_path)
    assert outcomes["refused"] and outcomes["partial"]
