import h5py
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage import event_file
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
