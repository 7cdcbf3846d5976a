import struct
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.aedat.aedat4 import open_aedat4
from sharpfield.recordings.recording import Frame, ReaderOptions, Recording
from tests.recordings import fuzz
from tests.recordings.aedat.aedat4_writer import write_aedat4
from tests.recordings.aedat.flatbuffer_writer import Scalar, Vector, packed
from tests.recordings.captured import (
    START_US,
    expect_equal_events,
    expect_equal_frames,
    some_frames,
    some_recording,
)
from tests.streams import HEIGHT, WIDTH, random_events

pytest.importorskip("lz4.frame")
pytest.importorskip("zstandard")

XML = """<dv version="2.0"><node name="outInfo" path="/outInfo/">{streams}</node></dv>"""
STREAM = """<node name="{number}"><attr key="typeIdentifier" type="string">{kind}</attr>
<node name="info"><attr key="sizeX" type="int">{width}</attr><attr key="sizeY" type="int">{height}
</attr><attr key="source" type="string">DAVIS_{number}</attr></node></node>"""


def stream(number: int, kind: str, width: object = WIDTH, height: object = HEIGHT) -> str:
    text = STREAM.format(number=number, kind=kind, width=width, height=height)
    return text.replace("\n</attr>", "</attr>")


def container(path: Path, streams: str, packets: list[tuple[int, bytes]], table: int = -1) -> Path:
    """An AEDAT4 file without compression."""
    xml = XML.format(streams=streams).encode()
    header = packed(
        "IOHE", [Scalar(0, "i", 0), Scalar(1, "q", table), Vector(2, xml + b"\0", len(xml))]
    )
    body = b"".join(struct.pack("<ii", number, len(data)) + data for number, data in packets)
    path.write_bytes(b"#!AER-DAT4.0\r\n" + header + body)
    return path


def event_packet(events: EventStream) -> bytes:
    """Events, sixteen bytes each, one after the other."""
    entries = b"".join(
        struct.pack("<qhhBxxx", t, x, y, int(p > 0))
        for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True)
    )
    return packed("EVTS", [Vector(0, entries, len(events))])


def frame_packet(image: np.ndarray, *parts: Scalar) -> bytes:
    pixels = image.tobytes()
    shape = [Scalar(6, "h", image.shape[1]), Scalar(7, "h", image.shape[0])]
    return packed("FRME", [*shape, Vector(10, pixels, len(pixels)), *parts])


@pytest.mark.parametrize("packing", ["none", "lz4", "zstd"])
def test_what_is_written_is_read(tmp_path: Path, packing) -> None:
    recording = some_recording()
    write_aedat4(tmp_path / "a.aedat4", recording, packing=packing)
    read = open_aedat4(tmp_path / "a.aedat4")
    assert (read.layout, read.size) == ("AEDAT4", (WIDTH, HEIGHT))
    expect_equal_events(read.load(), recording.load())
    expect_equal_frames(list(read.frames()), list(recording.frames()))
    for name in ("t_us", "edge", "channel"):
        np.testing.assert_array_equal(
            getattr(read.triggers(), name), getattr(recording.triggers(), name)
        )
    assert not str(read.log)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_colours_keep_their_order(tmp_path: Path, kind) -> None:
    recording = some_recording(0, some_frames(colours=(3,), kind=kind))
    write_aedat4(tmp_path / "a.aedat4", recording)
    expect_equal_frames(list(open_aedat4(tmp_path / "a.aedat4").frames()), list(recording.frames()))


def test_a_recording_without_frames_has_none(tmp_path: Path) -> None:
    recording = replace(some_recording(), frames=None, triggers=None)
    write_aedat4(tmp_path / "a.aedat4", recording)
    read = open_aedat4(tmp_path / "a.aedat4")
    assert read.frames is None and read.triggers is None
    expect_equal_events(read.load(), recording.load())


def test_packets_follow_each_other_in_time(tmp_path: Path) -> None:
    aedat = pytest.importorskip("aedat")
    write_aedat4(tmp_path / "a.aedat4", some_recording(40_000))
    kinds = [sorted(packet) for packet in aedat.Decoder(tmp_path / "a.aedat4")]
    begins = [
        packet["events"]["t"][0] if "events" in packet else packet["frame"]["exposure_begin_t"]
        for packet in aedat.Decoder(tmp_path / "a.aedat4")
        if "triggers" not in packet
    ]
    assert len(kinds) > 6 and begins == sorted(begins)


def test_another_library_reads_what_is_written(tmp_path: Path) -> None:
    aedat = pytest.importorskip("aedat")
    recording = some_recording(20_000, some_frames(colours=(3,)))
    write_aedat4(tmp_path / "a.aedat4", recording)
    packets = list(aedat.Decoder(tmp_path / "a.aedat4"))
    stored = np.concatenate([packet["events"] for packet in packets if "events" in packet])
    events = recording.load()
    np.testing.assert_array_equal(stored["t"].astype(np.int64), events.t_us)
    np.testing.assert_array_equal(stored["x"], events.x)
    np.testing.assert_array_equal(stored["y"], events.y)
    np.testing.assert_array_equal(np.where(stored["on"], 1, -1), events.p)
    for packet, frame in zip(
        [packet["frame"] for packet in packets if "frame" in packet],
        recording.frames(),
        strict=True,
    ):
        np.testing.assert_array_equal(packet["pixels"], frame.image)
        assert packet["exposure_begin_t"] == frame.open_us
        assert packet["exposure_end_t"] == frame.close_us


def test_the_camera_makers_own_library_reads_what_is_written(tmp_path: Path) -> None:
    dv = pytest.importorskip("dv_processing")
    recording = some_recording(20_000)
    write_aedat4(tmp_path / "a.aedat4", recording)
    read = dv.io.MonoCameraRecording(str(tmp_path / "a.aedat4"))
    assert read.getEventResolution() == (WIDTH, HEIGHT)
    found = []
    while read.isRunning("events"):
        batch = read.getNextEventBatch()
        found += [] if batch is None else [batch.numpy()]
    stored = np.concatenate(found)
    np.testing.assert_array_equal(stored["timestamp"], recording.load().t_us)
    np.testing.assert_array_equal(stored["x"], recording.load().x)
    frame, ours = read.getNextFrame(), next(recording.frames())
    assert (frame.timestamp, frame.exposure.microseconds) == (ours.open_us, 7000)
    np.testing.assert_array_equal(frame.image, ours.image)


def test_the_real_recording(samples: Path) -> None:
    read = open_aedat4(samples / "inivation" / "davis346_sample.aedat4")
    events = read.load()
    assert read.size == (346, 260)
    assert len(events) == 6676
    assert (events.t_us[0], events.t_us[-1]) == (1589163147368868, 1589163147538809)
    assert (events.p > 0).sum() == 3563
    frames = list(read.frames())
    assert [frame.image.shape for frame in frames] == [(260, 346)] * 4
    assert [frame.close_us - frame.open_us for frame in frames] == [500] * 4
    assert frames[0].open_us == 1589163147364965 and frames[0].image[0, 0] == 78
    assert not str(read.log)


def test_another_library_reads_the_same_from_the_real_recording(samples: Path) -> None:
    aedat = pytest.importorskip("aedat")
    path = samples / "inivation" / "davis346_sample.aedat4"
    packets = list(aedat.Decoder(path))
    stored = np.concatenate([packet["events"] for packet in packets if "events" in packet])
    events = open_aedat4(path).load()
    np.testing.assert_array_equal(stored["t"].astype(np.int64), events.t_us)
    np.testing.assert_array_equal(stored["x"], events.x)
    np.testing.assert_array_equal(stored["y"], events.y)
    np.testing.assert_array_equal(stored["on"], events.p > 0)


def test_exposures_stored_as_a_length(tmp_path: Path) -> None:
    image = np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH)
    packets = [
        (0, frame_packet(image, Scalar(0, "q", START_US), Scalar(11, "q", 4000))),
        (0, frame_packet(image, Scalar(0, "q", START_US + 9000))),
        (
            0,
            frame_packet(image, Scalar(3, "q", START_US + 20000), Scalar(4, "q", START_US + 21000)),
        ),
    ]
    read = open_aedat4(container(tmp_path / "a.aedat4", stream(0, "FRME"), packets))
    assert [(frame.open_us - START_US, frame.close_us - START_US) for frame in read.frames()] == [
        (0, 4000),
        (9000, 9000),
        (20000, 21000),
    ]


def test_frames_that_are_no_photographs_are_left_out_and_counted(tmp_path: Path) -> None:
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    at = Scalar(0, "q", START_US)
    packets = [
        (0, frame_packet(image, at, Scalar(12, "b", 2))),
        (0, frame_packet(image, at, Scalar(8, "h", 3))),
        (0, frame_packet(image[:, :4], at, Scalar(5, "b", 16))),
        (0, frame_packet(image, Scalar(3, "q", 900), Scalar(4, "q", 800))),
        (0, frame_packet(image, at)),
    ]
    read = open_aedat4(container(tmp_path / "a.aedat4", stream(0, "FRME"), packets))
    assert len(list(read.frames())) == 1
    assert read.log.counts == {
        "frames made from events": 1,
        "frames of a part of the sensor": 1,
        "damaged frames": 2,
    }


def test_events_that_cannot_be_are_left_out_and_counted(tmp_path: Path) -> None:
    x = np.array([0, 5, 40, 5, 5], np.uint16)
    t_us = np.array([10, 20, 20, 15, 30])
    events = EventStream(x, x % WIDTH, t_us, np.ones(5, np.int8), WIDTH, HEIGHT)
    packets = [(0, event_packet(events)), (0, b"no buffer at all"), (0, event_packet(events[4:]))]
    read = open_aedat4(container(tmp_path / "a.aedat4", stream(0, "EVTS"), packets))
    np.testing.assert_array_equal(read.load().t_us, [10, 20, 30, 30])
    assert read.log.counts == {
        "events outside the sensor": 1,
        "events earlier than those before them": 1,
        "damaged packets": 1,
    }


def test_a_torn_file_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    write_aedat4(tmp_path / "a.aedat4", recording := some_recording(40_000))
    data = (tmp_path / "a.aedat4").read_bytes()
    (tmp_path / "a.aedat4").write_bytes(data[: len(data) * 2 // 3])
    read = open_aedat4(tmp_path / "a.aedat4")
    events = read.load()
    assert 10_000 < len(events) < 40_000
    expect_equal_events(events, recording.load()[: len(events)])
    assert read.log.counts == {"truncated ends of the file": 1}


def test_several_cameras_must_be_chosen_from(tmp_path: Path) -> None:
    left, right = random_events(30), random_events(40, seed=1)
    path = container(
        tmp_path / "a.aedat4",
        stream(0, "EVTS") + stream(1, "EVTS"),
        [(0, event_packet(left)), (1, event_packet(right))],
    )
    with pytest.raises(CaptureError) as refused:
        open_aedat4(path)
    assert str(refused.value) == (
        "CaptureError: the file has several streams of EVTS\n"
        f"  where  {path}\n"
        "  got    0 EVTS of DAVIS_0, 1 EVTS of DAVIS_1\n"
        "  do     choose a topic: 0, or the name of a camera"
    )
    expect_equal_events(open_aedat4(path, ReaderOptions(topic="1")).load(), right)
    expect_equal_events(open_aedat4(path, ReaderOptions(topic="DAVIS_0")).load(), left)
    with pytest.raises(CaptureError, match="no stream or camera 2"):
        open_aedat4(path, ReaderOptions(topic="2"))


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="recording not found"):
        open_aedat4(tmp_path / "a.aedat4")


def test_the_size_is_asked_for_where_the_file_does_not_say(tmp_path: Path) -> None:
    events = random_events(30)
    path = container(
        tmp_path / "a.aedat4", stream(0, "EVTS", width="", height=""), [(0, event_packet(events))]
    )
    with pytest.raises(CaptureError, match="does not state its sensor resolution"):
        open_aedat4(path)
    expect_equal_events(open_aedat4(path, ReaderOptions(size=(WIDTH, HEIGHT))).load(), events)
    with pytest.raises(CaptureError, match="no sensor has this size"):
        open_aedat4(path, ReaderOptions(size=(0, 10)))


def test_a_size_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    write_aedat4(tmp_path / "a.aedat4", some_recording())
    with pytest.raises(CaptureError, match="640 x 480 given, 12 x 10 in the file"):
        open_aedat4(tmp_path / "a.aedat4", ReaderOptions(size=(640, 480)))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"#!AER-DAT2.0\r\n",
        b"#!AER-DAT4.0\r\n\xff\xff\xff\xff",
        b"#!AER-DAT4.0\r\n" + packed("EVTS", [Scalar(0, "i", 0)]),
        b"#!AER-DAT4.0\r\n" + packed("IOHE", [Scalar(0, "i", 9)]),
        b"#!AER-DAT4.0\r\n" + packed("IOHE", [Vector(2, b"<dv/>", 5)]),
        b"#!AER-DAT4.0\r\n" + packed("IOHE", [Vector(2, b"<!DOCTYPE a><dv/>", 17)]),
        b"#!AER-DAT4.0\r\n" + packed("IOHE", [Vector(2, b"<dv", 3)]),
    ],
)
def test_other_files_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.aedat4").write_bytes(data)
    with pytest.raises(CaptureError, match="the file is no AEDAT4"):
        open_aedat4(tmp_path / "a.aedat4")


def test_a_block_that_grows_without_end_is_left_out(tmp_path: Path, monkeypatch) -> None:
    write_aedat4(tmp_path / "a.aedat4", some_recording(), packing="zstd")
    monkeypatch.setattr("sharpfield.recordings.bytes.MAX_BLOCK", 10_000)
    read = open_aedat4(tmp_path / "a.aedat4")
    assert len(read.load()) == 0
    assert read.log.counts == {"damaged packets": 2}


@pytest.mark.parametrize("image", [np.zeros((4, 5), np.float32), np.zeros((4, 5, 2), np.uint8)])
def test_images_that_the_format_cannot_hold_are_refused(tmp_path: Path, image) -> None:
    recording = Recording(Path("a"), "test", frames=lambda: iter([Frame(image, 0, 0)]))
    with pytest.raises(CaptureError, match="AEDAT4 holds grey or RGB images of 8 or 16 bits"):
        write_aedat4(tmp_path / "a.aedat4", recording)
    assert not list(tmp_path.iterdir())


def written(packing) -> Callable[[], bytes]:
    def make() -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.aedat4"
            write_aedat4(path, some_recording(300), packing=packing)
            return path.read_bytes()

    return make


# A byte of LZ4 stands for up to 255 bytes, which is 16 events; one of Zstandard for any number.
for packing, most in (("none", 1.0), ("lz4", 16.0), ("zstd", 1e4)):
    fuzz.register(
        f"aedat4-{packing}", fuzz.Case(written(packing), open_aedat4, ".aedat4", most_per_byte=most)
    )


@pytest.mark.parametrize("packing", ["none", "lz4", "zstd"])
def test_damaged_files(tmp_path: Path, packing: str) -> None:
    outcomes = fuzz.campaign(f"aedat4-{packing}", files=150, folder=tmp_path)
    assert outcomes["refused"] and outcomes["partial"]
