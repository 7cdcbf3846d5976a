from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.recording import ReaderOptions
from sharpfield.recordings.tables.npz import SIZES, open_nmnist
from tests.recordings import fuzz


def record(x: int, y: int, t: int, bright: int) -> bytes:
    return bytes([x, y, bright << 7 | t >> 16, t >> 8 & 0xFF, t & 0xFF])


def random_records() -> bytes:
    draw = np.random.default_rng(0)
    t = np.cumsum(draw.integers(0, 600, 500)).tolist()
    x, y, bright = (draw.integers(0, most, 500).tolist() for most in (34, 34, 2))
    return b"".join(map(record, x, y, t, bright))


def open_small(path: Path):
    return open_nmnist(path, ReaderOptions(size=(34, 34)))


fuzz.register("nmnist", fuzz.Case(random_records, open_small, ".bin"))


@pytest.mark.parametrize(
    ("name", "size", "count", "first_us", "last_us"),
    [
        ("faces_easy_0001.bin", SIZES["ncaltech101"], 67_445, 6, 299_364),
        ("sample_nmnist.bin", SIZES["nmnist"], 4_325, 654, 311_175),
    ],
)
def test_real_files(
    name: str, size: tuple[int, int], count: int, first_us: int, last_us: int, samples: Path
) -> None:
    recording = open_nmnist(samples / "ncaltech_nmnist" / name, ReaderOptions(size=size))
    events = recording.load()
    assert (len(events), events.t_us[0], events.t_us[-1]) == (count, first_us, last_us)
    assert not str(recording.log)


def test_records(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(record(33, 1, 70_000, 1) + record(0, 33, 2**23 - 1, 0) + b"\x00")
    recording = open_small(path)
    events = recording.load()
    assert (events.x.tolist(), events.y.tolist()) == ([33, 0], [1, 33])
    assert (events.t_us.tolist(), events.p.tolist()) == ([70_000, 2**23 - 1], [1, -1])
    assert str(recording.log) == "1 truncated records"


def test_pauses_are_no_events(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(record(1, 1, 9, 1) + 2 * record(0, 240, 0, 0) + record(1, 1, 3, 1))
    assert open_small(path).load().t_us.tolist() == [9, 2 * 8192 + 3]


def test_damaged_files_end_cleanly(tmp_path: Path) -> None:
    assert fuzz.campaign("nmnist", files=120, folder=tmp_path).total() == 120


def test_what_is_missing_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(random_records())
    with pytest.raises(CaptureError, match="sensor resolution"):
        open_nmnist(path)
    path.write_bytes(b"abc")
    with pytest.raises(CaptureError, match="holds no event"):
        open_small(path)
