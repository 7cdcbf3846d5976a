from pathlib import Path

import h5py
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage import event_file
from sharpfield.storage.event_file import EventFile
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import write_events

SIZE = (12, 10)


def same(a, b):
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("x", "y", "t_us", "p"))


@pytest.fixture(params=["ours", "flat h5", "flat npz"])
def stored(request, tmp_path, some_events):
    """A stream, and an open file of it."""
    events = some_events(4_000)
    columns = {"x": events.x, "y": events.y, "t": events.t_us, "p": events.p > 0}
    path = tmp_path / ("events.npz" if "npz" in request.param else "events.h5")
    if request.param == "ours":
        write_events(path, events)
    elif request.param == "flat npz":
        np.savez(path, **columns)
    else:
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                file.create_dataset(name, data=column, chunks=(100,))
    unit = None if request.param == "ours" else "us"
    with open_events(path, unit=unit, size=SIZE) as file:
        yield events, file


def test_any_window_is_the_window_of_the_stream(stored, monkeypatch):
    events, file = stored
    monkeypatch.setattr(event_file, "SEARCHED", 16)
    starts = np.random.default_rng(3).integers(-5_000, 110_000, 20)
    for start in [*starts.tolist(), 0, 1_000, int(events.t_us[0]), int(events.t_us[-1])]:
        for length in (0, 1, 700, 200_000):
            expected = events.window(start, start + length)
            assert same(file.window(start, start + length), expected)


def test_chunks_make_up_the_stream(stored, monkeypatch):
    events, file = stored
    monkeypatch.setattr(event_file, "CHUNK", 333)
    chunks = list(file.chunks())
    assert [len(chunk) for chunk in chunks] == [333] * 12 + [4]
    np.testing.assert_array_equal(np.concatenate([c.t_us for c in chunks]), events.t_us)
    np.testing.assert_array_equal(np.concatenate([c.p for c in chunks]), events.p)


def flat(path, t, x=None):
    with h5py.File(path, "w") as file:
        file["t"] = np.asarray(t)
        file["x"] = np.zeros(len(t), np.int64) if x is None else np.asarray(x)
        file["y"] = file["p"] = np.zeros(len(t), np.uint8)
    return open_events(path, unit="us", size=SIZE)


@pytest.mark.parametrize("chunk", [2, 100])
def test_a_step_back_is_found_within_and_between_chunks(tmp_path, monkeypatch, chunk):
    monkeypatch.setattr(event_file, "CHUNK", chunk)
    with flat(tmp_path / "events.h5", [1, 2, 9, 30, 29, 31]) as file:
        with pytest.raises(CaptureError, match="not ascending") as caught:
            file.check()
    assert "at 30 us" in str(caught.value) and "at 29 us" in str(caught.value)


def test_an_event_outside_the_sensor_is_found(tmp_path):
    with flat(tmp_path / "events.h5", [1, 2, 3], x=[0, 12, 3]) as file:
        with pytest.raises(CaptureError, match="outside the sensor") as caught:
            file.check()
    assert "x from 0 to 12, sensor size 12" in str(caught.value)


def test_a_time_that_is_not_finite_is_found(tmp_path):
    with flat(tmp_path / "events.h5", [1.0, np.nan, 3.0]) as file:
        with pytest.raises(CaptureError, match="not a finite number"):
            file.check()


def test_no_events_at_all(tmp_path):
    with flat(tmp_path / "events.h5", np.zeros(0, np.int64)) as file:
        file.check()
        assert file.span_us() == (0, 0)
        assert len(file.window(0, 100)) == 0


def test_a_damaged_chunk_names_its_events(tmp_path):
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        for name in "xytp":
            column = file.create_dataset(
                name, data=np.zeros(1000, np.uint8), chunks=(500,), fletcher32=True
            )
        place = column.id.get_chunk_info(1)
    data = bytearray(path.read_bytes())
    data[place.byte_offset] ^= 255
    path.write_bytes(data)
    with open_events(path, unit="us", size=SIZE) as file:
        assert len(file.part(0, 500)) == 500
        with pytest.raises(CaptureError, match="cannot read events") as caught:
            file.part(400, 1000)
    assert "column p, events 400 to 999" in str(caught.value)


# Clocks of events and poses


POSES = (1_000_000, 2_200_000)


def check(events_us, known_us=POSES):
    """An opened file whose first and last event have these times."""
    file = EventFile(Path("events.h5"), {"t": np.array(events_us)}, unit="us", size=None)
    file.expect_overlap(known_us, known="poses", do="give the unit")


@pytest.mark.parametrize(
    "events",
    [(1_000_439, 2_199_999), (0, 10_000_000), (1_500_000, 1_600_000), (2_200_000, 2_300_000)],
)
def test_events_that_overlap_pass(events):
    check(events)


def test_ns_taken_for_us_are_recognised():
    with pytest.raises(CaptureError) as caught:
        check((1_000_438_515, 2_199_999_087))
    assert str(caught.value).splitlines() == [
        "CaptureError: events and poses were not taken at the same time",
        "  where  events.h5",
        "  got    events from 1000438515 to 2199999087 us, poses from 1000000 to 2200000 us",
        "  do     event times look like ns where us were expected: give the unit",
    ]


def test_us_taken_for_ns_are_recognised():
    with pytest.raises(CaptureError, match="event times look like us where ns were expected"):
        check((1_000, 2_200))


def test_wrong_units_are_recognised_even_where_clocks_overlap_at_zero():
    with pytest.raises(CaptureError, match="look like ns"):
        check((0, 10**9), (0, 10**6))
    with pytest.raises(CaptureError, match="look like us"):
        check((0, 10**3), (0, 10**6))


def test_another_zero_is_not_taken_for_another_unit():
    with pytest.raises(CaptureError, match="count from the same instant"):
        check((5_000_000, 6_000_000))
