import struct
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.aedat.aedat3 import open_aedat3
from sharpfield.recordings.recording import ReaderOptions
from tests.recordings import fuzz
from tests.recordings.aedat.test_aedat2 import rows, some_events
from tests.recordings.captured import expect_equal_events

HEADER = "#!AER-DAT3.1\r\n#Format: RAW\r\n{sources}#Start-Time: 2017-01-01\r\n#!END-HEADER\r\n"
DAVIS = HEADER.format(sources="#-Source 0: DVS128\r\n#Source 1: DAVIS240C\r\n")


def packet(
    kind: int, size: int, events: list[bytes], *, overflow: int = 0, source: int = 1, room: int = 0
) -> bytes:
    capacity = max(room, len(events))
    head = struct.pack(
        "<hhiiiiii", kind, source, size, 4, overflow, capacity, len(events), len(events)
    )
    return head + b"".join(events) + bytes(size * (capacity - len(events)))


def polarity(x: int, y: int, t: int, p: int, *, valid: int = 1) -> bytes:
    return struct.pack("<Ii", x << 17 | y << 2 | (p > 0) << 1 | valid, t)


def polarities(events: EventStream, **options: int) -> bytes:
    stored = [polarity(x, y, t & 0x7FFFFFFF, p) for x, y, t, p in rows(events)]
    return packet(1, 8, stored, **options)


def frame(image: np.ndarray, opened: int, closed: int, *, left: int = 0) -> bytes:
    height, width, *colours = image.shape
    info = 1 | (colours or [1])[0] << 1
    times = (opened - 9, closed + 9, opened, closed)
    return struct.pack("<Iiiiiiiii", info, *times, width, height, left, 0) + image.tobytes()


def recorded(path: Path, *packets: bytes, header: str = DAVIS) -> Path:
    path.write_bytes(header.encode() + b"".join(packets))
    return path


def test_events_and_other_packets(tmp_path: Path) -> None:
    events = some_events(2000, 240, 180)
    path = recorded(
        tmp_path / "a.aedat",
        polarities(events[:700]),
        packet(3, 36, [bytes(36)] * 3),
        polarities(some_events(10, 240, 180), source=0),
        polarities(events[700:], room=1500),
    )
    read = open_aedat3(path)
    assert (read.layout, read.size) == ("AEDAT3.1", (240, 180))
    expect_equal_events(read.load(), events)
    assert not str(read.log)


def test_bits_as_published(tmp_path: Path) -> None:
    word = 0b000000000000101_000000000000011_1_1
    path = recorded(tmp_path / "a.aedat", packet(1, 8, [struct.pack("<Ii", word, 9)]))
    events = open_aedat3(path).load()
    assert (events.x[0], events.y[0], events.t_us[0], events.p[0]) == (5, 3, 9, 1)


def test_times_go_on_where_they_wrap(tmp_path: Path) -> None:
    events = some_events(400, 240, 180, last_us=3 * 2**31)
    parts = [events.window(i << 31, (i + 1) << 31) for i in range(3)]
    packets = [polarities(part, overflow=i) for i, part in enumerate(parts)]
    expect_equal_events(open_aedat3(recorded(tmp_path / "a.aedat", *packets)).load(), events)


@pytest.mark.parametrize("colours", [(), (3,)])
def test_frames_and_their_exposures(tmp_path: Path, colours: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 2**16, (180, 240, *colours)).astype(np.uint16)
    stored = frame(image, 100, 7100)
    read = open_aedat3(
        recorded(tmp_path / "a.aedat", packet(2, len(stored), [stored, stored], overflow=1))
    )
    frames = list(read.frames())
    assert len(frames) == 2 and not str(read.log)
    np.testing.assert_array_equal(frames[1].image, image)
    assert (frames[1].open_us, frames[1].close_us) == (2**31 + 100, 2**31 + 7100)


def test_triggers(tmp_path: Path) -> None:
    events = [struct.pack("<Ii", kind << 1 | 1, 10 * kind) for kind in range(19)]
    events.append(struct.pack("<Ii", 2 << 1, 1))
    triggers = open_aedat3(recorded(tmp_path / "a.aedat", packet(0, 8, events))).triggers()
    assert triggers.t_us.tolist() == [20, 30, 40, 60, 70, 80, 90, 100, 110, 120, 130]
    assert triggers.edge.tolist() == [1, -1, 1, 1, -1, 1, 1, -1, 1, 1, -1]
    assert triggers.channel.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3]


def test_what_cannot_be_read_is_counted(tmp_path: Path) -> None:
    stored = frame(np.zeros((4, 4), np.uint16), 5, 6, left=2)
    path = recorded(
        tmp_path / "a.aedat",
        packet(1, 8, [polarity(1, 2, 3, 1), polarity(1, 2, 4, 1, valid=0), polarity(240, 2, 5, 1)]),
        packet(2, len(stored), [stored]),
        packet(1, 9, [bytes(9)]),
        polarities(some_events(10, 240, 180))[:50],
    )
    read = open_aedat3(path)
    assert read.load().t_us.tolist() == [3]
    assert read.log.counts == {
        "events marked invalid": 1,
        "events outside the sensor": 1,
        "damaged packets": 1,
        "truncated ends of the file": 1,
    }
    read = open_aedat3(path)
    assert not list(read.frames())
    assert read.log.counts["damaged or partial frames"] == 1


def test_one_of_several_sources_is_chosen(tmp_path: Path) -> None:
    header = HEADER.format(sources="#Source 1: DAVIS346B\r\n#Source 2: DVS128\r\n")
    events = some_events(100, 128, 128)
    packets = [polarities(some_events(50, 240, 180)), polarities(events, source=2)]
    path = recorded(tmp_path / "a.aedat", *packets, header=header)
    with pytest.raises(CaptureError) as refused:
        open_aedat3(path)
    assert str(refused.value) == (
        "CaptureError: the file has no source that was chosen\n"
        f"  where  {path}\n"
        "  got    1 DAVIS346B, 2 DVS128\n"
        "  do     give the number of a source as topic"
    )
    read = open_aedat3(path, ReaderOptions(topic="2"))
    expect_equal_events(read.load(), events)
    assert read.frames is None
    with pytest.raises(CaptureError, match="no source that was chosen"):
        open_aedat3(path, ReaderOptions(topic="3"))


def test_the_size_of_an_unknown_camera_is_asked_for(tmp_path: Path) -> None:
    header = HEADER.format(sources="#Source 1: Visualizer\r\n")
    path = recorded(tmp_path / "a.aedat", polarities(some_events(9, 50, 40)), header=header)
    with pytest.raises(CaptureError, match="does not state its sensor resolution"):
        open_aedat3(path)
    assert len(open_aedat3(path, ReaderOptions(size=(50, 40))).load()) == 9


@pytest.mark.parametrize(
    "data", [b"", b"#!AER-DAT3.0\r\n", b"#!AER-DAT3.1\r\n#Source 1: DVS128\r\n"]
)
def test_other_files_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.aedat").write_bytes(data)
    with pytest.raises(CaptureError, match="the file is no AEDAT3.1"):
        open_aedat3(tmp_path / "a.aedat")


def original() -> bytes:
    events = some_events(300, 240, 180)
    stored = frame(np.ones((18, 24), np.uint16), 5, 600)
    parts = [polarities(events[i : i + 50]) for i in range(0, 300, 50)]
    edges = packet(0, 8, [struct.pack("<Ii", 5, 77)])
    return DAVIS.encode() + b"".join(
        [*parts[:3], packet(2, len(stored), [stored]), edges, *parts[3:]]
    )


fuzz.register("aedat3", fuzz.Case(original, open_aedat3, ".aedat", most_per_byte=1.0))


def test_damaged_files(tmp_path: Path) -> None:
    outcomes = fuzz.campaign("aedat3", files=200, folder=tmp_path)
    assert outcomes["refused"] and outcomes["partial"]
