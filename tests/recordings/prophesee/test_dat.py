from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.prophesee import dat
from sharpfield.recordings.prophesee.dat import open_dat
from sharpfield.recordings.recording import ReaderOptions
from tests.recordings import fuzz

HEADER = "% Data file containing CD events\n% Version 2\n% Width 640\n% Height 480\n"

Event = tuple[int, int, int, int]


def record(x: int, y: int, t: int, bright: int) -> bytes:
    return np.array([t % 2**32, bright << 28 | y << 14 | x], "<u4").tobytes()


def write(folder: Path, data: bytes, *, header: str = HEADER, kind: int = 12) -> Path:
    path = folder / "recording.dat"
    path.write_bytes(header.encode() + bytes([kind, 8]) + data)
    return path


def listed(events: EventStream) -> list[Event]:
    return list(
        zip(*(c.tolist() for c in (events.x, events.y, events.t_us, events.p)), strict=True)
    )


def random_records(count: int) -> bytes:
    draw = np.random.default_rng(0)
    t = np.cumsum(draw.integers(0, 9, count))
    x, y, bright = (draw.integers(0, most, count).tolist() for most in (640, 480, 2))
    return b"".join(map(record, x, y, t.tolist(), bright))


fuzz.register(
    "dat", fuzz.Case(lambda: HEADER.encode() + b"\x0c\x08" + random_records(500), open_dat, ".dat")
)


def test_real_cars(samples: Path) -> None:
    recording = open_dat(samples / "prophesee/sample_ncars.dat", ReaderOptions(size=(120, 100)))
    events = recording.load()
    assert len(events) == 2_009
    assert (events.t_us[-1], (events.p == 1).sum()) == (99_952, 1_350)
    assert listed(events)[:3] == [(25, 8, 0, -1), (67, 35, 35, -1), (56, 27, 152, 1)]
    assert recording.layout == "DAT" and not str(recording.log)


def test_records(tmp_path: Path) -> None:
    data = record(639, 479, 5, 1) + record(0, 1, 5, 0) + record(7, 8, 2**31, 1)
    recording = open_dat(write(tmp_path, data))
    assert recording.size == (640, 480)
    assert listed(recording.load()) == [(639, 479, 5, 1), (0, 1, 5, -1), (7, 8, 2**31, 1)]


def test_records_of_the_first_version(tmp_path: Path) -> None:
    data = np.array([9, 1 << 17 | 200 << 9 | 300], "<u4").tobytes()
    path = write(tmp_path, data, header="% Width 304\n% Height 240\n", kind=0)
    assert listed(open_dat(path).load()) == [(300, 200, 9, 1)]


def test_times_wrap(tmp_path: Path) -> None:
    times = [2**32 - 2, 2**32 - 1, 2**32, 2**32 + 5, 3 * 2**31]
    times += [3 * 2**31 + 9, 2**33 - 1, 2**33 + 1]
    data = b"".join(record(1, 1, t, 1) for t in times)
    assert open_dat(write(tmp_path, data)).load().t_us.tolist() == times


def test_a_lone_time_is_no_wrap(tmp_path: Path) -> None:
    times = [100, 101, 101 + 2**31, 102, 103]
    recording = open_dat(write(tmp_path, b"".join(record(1, 1, t, 1) for t in times)))
    assert recording.load().t_us.tolist() == [100, 101, 102, 103]
    assert str(recording.log) == "1 times out of line with those before and after"


def test_events_that_come_a_little_late_are_put_in_order(tmp_path: Path) -> None:
    data = b"".join(record(x, 1, t, 1) for x, t in enumerate([10, 30, 20, 20, 40]))
    events = open_dat(write(tmp_path, data)).load()
    assert (events.t_us.tolist(), events.x.tolist()) == ([10, 20, 20, 30, 40], [0, 2, 3, 1, 4])


@pytest.mark.parametrize("block", [3, 8, 1000])
def test_blocks_may_be_cut_anywhere(
    block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, random_records(300))
    whole = listed(open_dat(path).load())
    cut = dat.read_blocks
    monkeypatch.setattr(dat, "read_blocks", lambda path, start: cut(path, start, block))
    assert len(whole) == 300 and listed(open_dat(path).load()) == whole


def test_trigger_edges(tmp_path: Path) -> None:
    data = np.array([[5, 1], [9, 6 << 26]], "<u4").tobytes()
    recording = open_dat(write(tmp_path, data, kind=14))
    assert recording.triggers is not None and recording.events is None
    found = recording.triggers()
    assert (found.t_us.tolist(), found.edge.tolist()) == ([5, 9], [1, -1])
    assert found.channel.tolist() == [0, 6]


def test_a_torn_end_is_told(tmp_path: Path) -> None:
    recording = open_dat(write(tmp_path, record(1, 2, 3, 1) + b"\x01\x02"))
    assert len(recording.load()) == 1 and str(recording.log) == "1 truncated records"


def test_damaged_files_end_cleanly(tmp_path: Path) -> None:
    assert fuzz.campaign("dat", files=120, folder=tmp_path)["partial"] > 3


@pytest.mark.parametrize(
    ("header", "kind", "message"),
    [
        ("", 12, "no header"),
        (HEADER, 3, "type 3, 8 bytes"),
        ("% Version 2\n", 12, "sensor resolution"),
    ],
)
def test_files_that_do_not_do(header: str, kind: int, message: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=message):
        open_dat(write(tmp_path, record(1, 2, 3, 1), header=header, kind=kind))


@pytest.mark.parametrize("version", ["% Version 2.0\n", "% version 2\n", "%Version 2\r\n"])
def test_versions_of_many_hands(version: str, tmp_path: Path) -> None:
    header = f"{version}% geometry 640x480\n"
    recording = open_dat(write(tmp_path, record(500, 400, 7, 1), header=header))
    assert recording.size == (640, 480)
    assert listed(recording.load()) == [(500, 400, 7, 1)]
