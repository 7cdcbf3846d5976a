from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.recordings.prophesee.evt import open_evt
from sharpfield.storage import evt_writer
from sharpfield.storage.evt_writer import ENCODINGS, writing_evt
from tests.streams import random_events


def stream(rows: list[tuple[int, int, int, int]], size: tuple[int, int] = (1280, 720)):
    x, y, t, p = np.array(rows, np.int64).reshape(-1, 4).T
    return EventStream(
        x.astype(np.uint16),
        y.astype(np.uint16),
        t,
        p.astype(np.int8),
        width=size[0],
        height=size[1],
    )


def busy_events(count: int, *, span_us: int, size: tuple[int, int] = (346, 260)) -> EventStream:
    """Rows of neighbours among single events, as sensors report them."""
    draw = np.random.default_rng(0)
    rows = []
    for t in np.sort(draw.integers(0, span_us, count // 10)).tolist():
        y, x, p = int(draw.integers(size[1])), int(draw.integers(size[0] - 20)), 1
        rows += [(x + k, y, t, p) for k in range(20) if draw.random() < 0.4]
        rows += [(int(draw.integers(size[0])), int(draw.integers(size[1])), t, -1)]
    return stream(rows, size)


def written(path: Path, events: EventStream, encoding: str, cuts: list[int] | None = None) -> Path:
    cuts = [0, *(cuts or []), len(events)]
    with writing_evt(path, events[:0], encoding=encoding) as writer:
        for first, last in zip(cuts, cuts[1:], strict=False):
            writer.append(events[first:last])
    return path


def expect_equal(path: Path, events: EventStream) -> None:
    recording = open_evt(path)
    found = recording.load()
    assert recording.size == (events.width, events.height) and not str(recording.log)
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(events, name))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("span_us", [100, 50_000, 90_000_000])
def test_what_is_written_is_read(encoding: str, span_us: int, tmp_path: Path) -> None:
    events = busy_events(3000, span_us=span_us)
    expect_equal(written(tmp_path / "a.raw", events, encoding, [7, 7, 1234]), events)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("start_us", [0, 4096, 2**24 - 1, 2**34 + 5, 1_700_000_000_000_000, -77])
def test_recordings_may_begin_at_any_time(encoding: str, start_us: int, tmp_path: Path) -> None:
    events = random_events(200)
    events = replace(events, t_us=events.t_us + start_us)
    expect_equal(written(tmp_path / "a.raw", events, encoding), events)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_long_gaps_are_no_wraps(encoding: str, tmp_path: Path) -> None:
    gaps = [0, 1, 5_000, 300_000, 9_000_000, 17_000_000, 40_000_000, 3_600_000_000, 2**34 + 3]
    events = stream([(1, 2, t, 1) for t in np.cumsum(gaps).tolist()])
    expect_equal(written(tmp_path / "a.raw", events, encoding), events)


def test_neighbours_of_a_row_share_words(tmp_path: Path) -> None:
    """A header, high and low time, a row; then three words and a base for all 32 columns."""
    events = stream([(x, 5, 100, 1) for x in range(64, 96)])
    path = written(tmp_path / "a.raw", events, "evt3")
    assert (
        path.read_bytes().partition(b"% end\n")[2]
        == np.array([0x8000, 0x6064, 0x0005, 0x3840, 0x4FFF, 0x4FFF, 0x50FF], "<u2").tobytes()
    )
    expect_equal(path, events)


def test_words_are_written_in_several_goes(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(evt_writer, "WORDS", 16)
    events = busy_events(500, span_us=9_000_000)
    expect_equal(written(tmp_path / "a.raw", events, "evt3"), events)


def test_real_events_survive(samples: Path, tmp_path: Path) -> None:
    for name, most in (("evt3_sample", 3.2), ("evt2_sample", 4.2)):
        events = open_evt(samples / f"prophesee/{name}.raw").load()
        for encoding in ENCODINGS:
            path = written(tmp_path / f"{encoding}.raw", events, encoding)
            expect_equal(path, events)
        assert path.stat().st_size < most * len(events)


def test_faery_reads_it(tmp_path: Path) -> None:
    faery = pytest.importorskip("faery")
    events = busy_events(3000, span_us=30_000_000)
    for encoding in ENCODINGS:
        path = written(tmp_path / f"{encoding}.raw", events, encoding)
        found = faery.events_stream_from_file(path).to_array()
        for name, column in (("x", events.x), ("y", events.y), ("t", events.t_us)):
            np.testing.assert_array_equal(found[name].astype(np.int64), column)
        np.testing.assert_array_equal(found["on"], events.p > 0)


def test_colour_and_no_events_at_all(tmp_path: Path) -> None:
    none = replace(random_events(0), bayer="RGGB")
    recording = open_evt(written(tmp_path / "a.raw", none, "evt3"))
    assert len(recording.load()) == 0
    assert (recording.size, recording.bayer) == ((12, 10), "RGGB")


def test_what_raw_files_cannot_hold(tmp_path: Path) -> None:
    events, path = random_events(5), tmp_path / "a.raw"
    rectified = replace(events, x=events.x.astype(np.float32), y=events.y.astype(np.float32))
    for other, message in (
        (rectified, "rectified positions"),
        (replace(events, width=2049), "up to 2048 x 2048"),
        (replace(events, tracks=2, track=np.zeros(5, np.uint16)), "2 cameras"),
    ):
        with pytest.raises(CaptureError, match=message):
            written(path, other, "evt3")
    with pytest.raises(CaptureError, match="begin before the last"):
        with writing_evt(path, events) as writer:
            writer.append(events)
            writer.append(events)
    with pytest.raises(OptionError, match="use evt2 or evt3"):
        written(path, events, "evt4")
    assert not list(tmp_path.iterdir())
