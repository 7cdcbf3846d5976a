import h5py
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, MissingExtra
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_layouts import open_events

SIZE = (12, 10)


def write_flat(path, *, times=(1_000, 2_500, 2_500, 9_999), columns="xytp"):
    values = {"x": [1, 2, 3, 11], "y": [0, 9, 4, 5], "t": list(times), "p": [0, 1, 1, 0]}
    with h5py.File(path, "w") as file:
        for name in columns:
            file[name] = np.array(values[name])
    return path


def write_dsec(path, times_us, *, offset_us):
    times_us = np.asarray(times_us, np.uint32)
    marks = np.searchsorted(times_us, np.arange(times_us[-1] // 1000 + 1) * 1000)
    with h5py.File(path, "w") as file:
        file["events/t"] = times_us
        for name in "xyp":
            file[f"events/{name}"] = (np.arange(len(times_us)) % 2).astype(np.uint16)
        file["ms_to_idx"] = marks.astype(np.uint64)
        file["t_offset"] = np.int64(offset_us)
    return path


def test_a_flat_file_needs_the_unit(tmp_path):
    path = write_flat(tmp_path / "events.h5")
    with open_events(path, unit="ns", size=SIZE) as file:
        np.testing.assert_array_equal(read_events(file).t_us, [1, 3, 3, 10])
    with open_events(path, unit="us", size=SIZE) as file:
        events = read_events(file)
    np.testing.assert_array_equal(events.t_us, [1_000, 2_500, 2_500, 9_999])
    np.testing.assert_array_equal(events.p, [-1, 1, 1, -1])
    np.testing.assert_array_equal(events.x, [1, 2, 3, 11])


def test_an_npz_reads_like_the_same_hdf5(tmp_path):
    hdf5 = write_flat(tmp_path / "events.h5")
    with h5py.File(hdf5) as file:
        np.savez_compressed(tmp_path / "events.npz", **{name: file[name][:] for name in "xytp"})
    with (
        open_events(hdf5, unit="us", size=SIZE) as a,
        open_events(tmp_path / "events.npz", unit="us", size=SIZE) as b,
    ):
        for name in ("x", "y", "t_us", "p"):
            np.testing.assert_array_equal(
                getattr(read_events(a), name), getattr(read_events(b), name)
            )


def test_dsec_counts_from_its_offset_in_us(tmp_path):
    path = write_dsec(tmp_path / "events.h5", [0, 10, 1_500, 4_200, 4_300], offset_us=7_000_000)
    with open_events(path, size=SIZE) as file:
        assert file.unit == "us"
        assert file.span_us() == (7_000_000, 7_004_300)
        np.testing.assert_array_equal(
            file.window(7_001_000, 7_004_300).t_us, [7_001_500, 7_004_200]
        )


def test_neither_unit_nor_size_is_guessed(tmp_path):
    path = write_flat(tmp_path / "events.h5")
    with open_events(path, size=SIZE) as file:
        with pytest.raises(CaptureError, match="does not state the unit") as caught:
            file.part(0, 1)
    assert "ns, us, ms or s" in str(caught.value)
    with open_events(path, unit="us") as file:
        with pytest.raises(CaptureError, match="does not state its sensor resolution"):
            file.part(0, 1)


def test_a_missing_file(tmp_path):
    with pytest.raises(CaptureError, match="event file not found"):
        open_events(tmp_path / "events.h5")


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_a_truncated_file_says_so(tmp_path, suffix):
    path = tmp_path / f"events.{suffix}"
    if suffix == "h5":
        write_flat(path, times=range(4))
    else:
        np.savez(path, x=np.zeros(9), y=np.zeros(9), t=np.zeros(9), p=np.zeros(9))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(CaptureError, match="truncated|not a readable npz") as caught:
        open_events(path)
    assert str(path) in str(caught.value) and "again" in str(caught.value)


def test_columns_of_different_lengths(tmp_path):
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        for i, name in enumerate("xytp"):
            file[name] = np.zeros(5 + i // 3)
    with pytest.raises(CaptureError, match="different lengths") as caught:
        open_events(path)
    assert "x 5, y 5, t 5, p 6" in str(caught.value)


def test_a_file_without_events_says_what_it_holds(tmp_path):
    path = write_flat(tmp_path / "events.h5", columns="xy")
    with pytest.raises(CaptureError, match="no events in a known layout") as caught:
        open_events(path)
    assert "holds x, y" in str(caught.value)


def test_prophesees_own_hdf5_is_named(tmp_path):
    with h5py.File(tmp_path / "events.h5", "w") as file:
        file["CD/events"] = np.zeros(3)
    with pytest.raises(CaptureError, match="convert Prophesee's own HDF5"):
        open_events(tmp_path / "events.h5")


def test_a_matrix_of_events_is_refused(tmp_path):
    path = write_flat(tmp_path / "events.h5", columns="xyp")
    with h5py.File(path, "a") as file:
        file["t"] = np.zeros((4, 2))
    with pytest.raises(CaptureError, match="one-dimensional"):
        open_events(path)


def test_an_unknown_compression_says_what_to_do(tmp_path, monkeypatch):
    path = write_flat(tmp_path / "events.h5", columns="xyp")
    with h5py.File(path, "a") as file:
        file.create_dataset("t", data=np.arange(4), chunks=(4,), compression="gzip")
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    with pytest.raises(CaptureError, match="compressed in a way") as caught:
        open_events(path)
    assert "HDF5 filter 1" in str(caught.value) and "convert" in str(caught.value)


def test_blosc_is_known_by_its_number(tmp_path, monkeypatch):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    path = write_flat(tmp_path / "events.h5", columns="xyp")
    with h5py.File(path, "a") as file:
        file.create_dataset("t", data=np.arange(4), chunks=(4,), **hdf5plugin.Blosc())
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: code != 32001)
    with pytest.raises(MissingExtra, match=r"sharpfield\[io\]"):
        open_events(path)


def test_every_dialect_is_read_for_any_layout(tmp_path):
    path = tmp_path / "events.h5"
    rows = np.stack([[5, 8, 8], [1, 2, 3], [0, 4, 9], [1, 0, 1]], -1)  # t, x, y, p
    with h5py.File(path, "w") as file:
        for camera in ("left", "right"):
            file[f"davis/{camera}/events"] = np.roll(rows, -1, 1)[:, [0, 1, 3, 2]].astype(float)
    with pytest.raises(CaptureError, match="several cameras"):
        open_events(path, size=SIZE)
    with open_events(path, size=SIZE, camera="right") as file:
        events = read_events(file)
    assert events.t_us.tolist() == [5_000_000, 8_000_000, 8_000_000]
    assert (events.x.tolist(), events.y.tolist()) == ([1, 2, 3], [0, 4, 9])
    assert events.p.tolist() == [1, -1, 1]
