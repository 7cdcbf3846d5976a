import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.recording import ReaderOptions
from sharpfield.recordings.tables import npz
from sharpfield.recordings.tables.npz import open_npy, open_npz, open_npz_folder
from sharpfield.storage.event_writer import exporting_events
from tests.recordings import fuzz
from tests.streams import HEIGHT, WIDTH, random_events

SIZE = (WIDTH, HEIGHT)
EVENTS = random_events(500)


def columns(scale: int = 1) -> dict[str, np.ndarray]:
    return {"x": EVENTS.x, "y": EVENTS.y, "t": EVENTS.t_us * scale, "p": EVENTS.p > 0}


def table(order: str, kind: type = np.float64) -> np.ndarray:
    return np.stack([columns()[name].astype(kind) for name in order], -1)


def positions() -> dict[str, np.ndarray]:
    found = columns(1000)
    return {
        "position": np.stack([EVENTS.x, EVENTS.y], -1),
        "timestamp": found["t"],
        "polarity": found["p"],
    }


def expect_same(recording) -> None:
    found = recording.load()
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(EVENTS, name), name)
    assert found.x.dtype == np.uint16
    assert (found.width, found.height) == SIZE
    assert str(recording.log) == ""


def saved(path: Path, write: Callable, *args, **arrays) -> Path:
    write(path, *args, **arrays)
    return path


# Each dialect gives the same events


def test_columns_in_ns(tmp_path):
    path = saved(tmp_path / "e.npz", np.savez_compressed, **columns(1000))
    expect_same(open_npz(path, ReaderOptions(unit="ns", size=SIZE)))


def test_what_we_write_says_its_unit_and_size(tmp_path):
    with exporting_events(tmp_path / "e.npz", EVENTS[:0]) as append:
        append(EVENTS)
    expect_same(open_npz(tmp_path / "e.npz"))


def test_positions_are_in_ns(tmp_path):
    path = saved(tmp_path / "raw_events.npz", np.savez, **positions())
    expect_same(open_npz(path, ReaderOptions(size=SIZE)))


def test_a_folder_of_numbered_files_is_in_ns(tmp_path):
    for i, part in enumerate(np.array_split(np.arange(len(EVENTS)), 3)):
        pieces = {name: column[part] for name, column in columns(1000).items()}
        np.savez(tmp_path / f"{i:010d}.npz", **pieces)
    expect_same(open_npz_folder(tmp_path, ReaderOptions(size=SIZE)))


@pytest.mark.parametrize("order", ["xytp", "txyp"])
@pytest.mark.parametrize("kind", [np.float64, np.int64, np.float32])
def test_columns_of_a_table_are_told_by_what_they_hold(tmp_path, order, kind):
    path = saved(tmp_path / "e.npy", np.save, table(order, kind))
    recording = open_npy(path, ReaderOptions(unit="us", size=SIZE))
    assert recording.layout == f"npy table {order}"
    expect_same(recording)


def test_records(tmp_path):
    found = columns()
    records = np.zeros(len(EVENTS), [("t", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "u1")])
    for name, column in (*found.items(), ("polarity", found["p"])):
        if name in records.dtype.names:
            records[name] = column
    expect_same(
        open_npy(saved(tmp_path / "e.npy", np.save, records), ReaderOptions(unit="us", size=SIZE))
    )


# Reading piece by piece gives what reading at once gives


@pytest.mark.parametrize("chunk", [1, 7, 499, 500, 501])
def test_the_length_of_chunks_changes_nothing(tmp_path, monkeypatch, chunk):
    monkeypatch.setattr("sharpfield.recordings.tables.columns.CHUNK", chunk)
    monkeypatch.setattr(npz, "CHUNK", chunk)
    path = saved(tmp_path / "e.npy", np.save, table("txyp"))
    expect_same(open_npy(path, ReaderOptions(unit="us", size=SIZE)))


# Events that cannot be


def test_events_beside_the_sensor_are_counted(tmp_path):
    wide = columns() | {"x": np.where(np.arange(500) % 10 == 0, 60_000, EVENTS.x).astype(np.int64)}
    recording = open_npz(
        saved(tmp_path / "e.npz", np.savez, **wide), ReaderOptions(unit="us", size=SIZE)
    )
    assert len(recording.load()) == 450
    assert str(recording.log) == "50 events outside the sensor"


def test_rectified_positions_stay_between_pixels(tmp_path):
    shifted = columns() | {"x": EVENTS.x + 0.25, "y": EVENTS.y - 0.5}
    found = open_npz(
        saved(tmp_path / "e.npz", np.savez, **shifted), ReaderOptions(unit="us", size=SIZE)
    ).load()
    assert found.rectified
    np.testing.assert_array_equal(found.x, EVENTS.x + 0.25)


def test_no_events_at_all(tmp_path):
    none = {name: column[:0] for name, column in columns().items()}
    recording = open_npz(
        saved(tmp_path / "e.npz", np.savez, **none), ReaderOptions(unit="us", size=SIZE)
    )
    assert len(recording.load()) == 0


# What has to be asked


def test_the_unit_is_asked_for_with_what_each_would_mean(tmp_path):
    path = saved(tmp_path / "e.npz", np.savez, **columns())
    with pytest.raises(CaptureError, match="does not state the unit") as caught:
        open_npz(path, ReaderOptions(size=SIZE))
    assert "0.08" in str(caught.value) and "s if us" in str(caught.value)
    with pytest.raises(CaptureError, match="state its sensor resolution"):
        open_npz(path, ReaderOptions(unit="us"))


def test_a_folder_of_other_names_does_not_say_its_unit(tmp_path):
    np.savez(tmp_path / "seq1.npz", **columns())
    with pytest.raises(CaptureError, match="does not state the unit"):
        open_npz_folder(tmp_path, ReaderOptions(size=SIZE))


def test_a_table_that_may_be_either_is_asked_about(tmp_path):
    rows = np.array([[1, 1, 2, 1], [2, 2, 3, 0]])
    path = saved(tmp_path / "e.npy", np.save, rows)
    with pytest.raises(CaptureError, match="cannot tell which column is which") as caught:
        open_npy(path, ReaderOptions(unit="us", size=SIZE))
    assert "xytp, txyp" in str(caught.value)
    assert open_npy(
        path, ReaderOptions(unit="us", size=SIZE, columns="txyp")
    ).load().t_us.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"t": EVENTS.t_us[::-1]}, "event times are not ascending"),
        ({"p": np.full(500, 7)}, "polarity must be 0 or 1"),
        ({"t": np.full(500, np.nan)}, "not a finite number"),
        ({"x": EVENTS.x[:-1]}, "different lengths"),
        ({"x": np.array([{}], object)}, "pickled"),
    ],
)
def test_unsound_columns_are_refused(tmp_path, wrong, message):
    path = saved(tmp_path / "e.npz", np.savez, **(columns() | wrong))
    with pytest.raises(CaptureError, match=message):
        open_npz(path, ReaderOptions(unit="us", size=SIZE)).load()


def test_time_that_goes_back_between_files_is_refused(tmp_path):
    for i in range(2):
        np.savez(tmp_path / f"{i:010d}.npz", **columns(1000))
    with pytest.raises(CaptureError, match="at the end of the file before"):
        open_npz_folder(tmp_path, ReaderOptions(size=SIZE)).load()


def test_pickled_npy_is_refused(tmp_path):
    path = saved(tmp_path / "e.npy", np.save, np.array([{}], object))
    with pytest.raises(CaptureError, match="pickled"):
        open_npy(path, ReaderOptions(unit="us", size=SIZE))


def _bytes(write: Callable, *args, **arrays) -> bytes:
    file = io.BytesIO()
    write(file, *args, **arrays)
    return file.getvalue()


fuzz.register(
    "npz",
    fuzz.Case(
        lambda: _bytes(np.savez_compressed, **columns()),
        lambda path: open_npz(path, ReaderOptions(unit="us", size=SIZE)),
        ".npz",
    ),
)
fuzz.register(
    "npz-positions",
    fuzz.Case(
        lambda: _bytes(np.savez, **positions()),
        lambda path: open_npz(path, ReaderOptions(size=SIZE)),
        ".npz",
    ),
)
fuzz.register(
    "npy",
    fuzz.Case(
        lambda: _bytes(np.save, table("txyp")),
        lambda path: open_npy(path, ReaderOptions(unit="us", size=SIZE)),
        ".npy",
    ),
)


@pytest.mark.parametrize("name", ["npz", "npz-positions", "npy"])
def test_damaged_files_end_well(tmp_path, name):
    outcomes = fuzz.campaign(name, files=150, folder=tmp_path)
    assert outcomes["refused"]


def test_the_sample_of_a_table(samples):
    found = open_npy(
        samples / "ecd_tubrip" / "boxes_rotation" / "events.npy",
        ReaderOptions(unit="s", size=(240, 180)),
    )
    assert len(found.load()) == 29_158
    assert found.layout == "npy table txyp"
