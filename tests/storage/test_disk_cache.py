from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.capture import Capture, Split
from sharpfield.storage import disk_cache
from sharpfield.storage.disk_cache import cache_folder, cache_key, cached, cached_arrays


class Counter:
    """Counts how often its arrays are computed."""

    def __init__(self) -> None:
        self.calls = 0

    def compute(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return {"sum": np.arange(3.0) + self.calls}


@pytest.fixture
def long(panning: Capture, tmp_path) -> Capture:
    """The panning capture with its images mapped, as those of long ones are."""
    images = np.lib.format.open_memmap(
        tmp_path / "images.npy", "w+", panning.frames.images.dtype, panning.frames.images.shape
    )
    images[:] = panning.frames.images
    images.flush()
    mapped = np.load(tmp_path / "images.npy", mmap_mode="r")
    return replace(panning, frames=replace(panning.frames, images=mapped))


def test_arrays_of_a_long_capture_are_computed_once(long):
    counter = Counter()
    found = [cached_arrays(long, "sum", {"by": 1}, counter.compute)["sum"] for _ in range(3)]
    assert counter.calls == 1
    for array in found:
        np.testing.assert_array_equal(array, [1, 2, 3])


def test_arrays_of_a_short_capture_are_computed_each_time(panning, tmp_path):
    counter = Counter()
    for _ in range(2):
        cached_arrays(panning, "sum", {}, counter.compute)
    assert counter.calls == 2


def test_whatever_the_arrays_depend_on_is_in_the_key(long):
    counter = Counter()
    cached_arrays(long, "sum", {"by": 1}, counter.compute)
    cached_arrays(long, "sum", {"by": 2}, counter.compute)
    cached_arrays(long, "other", {"by": 1}, counter.compute)
    cached_arrays(
        replace(long, split=Split(long.split.train[1:], long.split.test)),
        "sum",
        {"by": 1},
        counter.compute,
    )
    cached_arrays(replace(long, far=long.far + 1), "sum", {"by": 1}, counter.compute)
    wider = replace(long.camera, fx_px=long.camera.fx_px + 1)
    cached_arrays(replace(long, camera=wider), "sum", {"by": 1}, counter.compute)
    assert counter.calls == 6


def test_images_written_again_have_another_key(long):
    counter = Counter()
    cached_arrays(long, "sum", {}, counter.compute)
    path = long.frames.images.filename
    again = np.load(path)
    np.save(path, np.concatenate([again, again]))
    mapped = np.load(path, mmap_mode="r")[: len(again)]
    smaller = replace(long, frames=replace(long.frames, images=mapped))
    cached_arrays(smaller, "sum", {}, counter.compute)
    assert counter.calls == 2


def test_a_damaged_entry_is_computed_again(long, tmp_path):
    counter = Counter()
    cached_arrays(long, "sum", {}, counter.compute)
    (file,) = tmp_path.glob("sum-*.npz")
    file.write_bytes(file.read_bytes()[:50])
    np.testing.assert_array_equal(cached_arrays(long, "sum", {}, counter.compute)["sum"], [2, 3, 4])
    np.testing.assert_array_equal(cached_arrays(long, "sum", {}, counter.compute)["sum"], [2, 3, 4])


def test_where_nothing_can_be_written_arrays_are_computed_each_time(long, monkeypatch):
    monkeypatch.setattr(disk_cache.os, "access", lambda *_: False)
    counter = Counter()
    for _ in range(2):
        cached_arrays(long, "sum", {}, counter.compute)
    assert counter.calls == 2


def test_a_key_changes_with_files_and_parameters(tmp_path):
    file, other = tmp_path / "a.bin", tmp_path / "b.bin"
    file.write_bytes(b"a")
    other.write_bytes(b"a")
    keys = [
        cache_key([file]),
        cache_key([other]),
        cache_key([file, other]),
        cache_key([file], "colour"),
        cache_key([file], {"size": 3}),
        cache_key([file], np.zeros(3)),
        cache_key([file], np.zeros(3, np.int64)),
        cache_key([file], np.zeros((3, 1))),
    ]
    assert len(set(keys)) == len(keys)
    assert keys[0] == cache_key([file])
    file.write_bytes(b"ab")
    assert keys[0] != cache_key([file])


def test_an_entry_appears_whole_or_not_at_all(tmp_path):
    def fails(path):
        (path / "part.txt").write_text("half")
        raise ValueError("disk full")

    with pytest.raises(ValueError, match="disk full"):
        cached(tmp_path / "cache", "events", "00", fails)
    assert list((tmp_path / "cache").iterdir()) == []


def test_older_entries_of_a_name_are_deleted_where_only_one_is_wanted(tmp_path):
    for name, key in (("events", "00"), ("events", "11"), ("events-b", "22"), ("events", "33")):
        cached(tmp_path, name, key, lambda path: (path / "x").touch(), replaces=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events-33", "events-b-22"]


def test_a_folder_that_cannot_be_written_uses_the_cache_of_the_user(monkeypatch, tmp_path):
    path = tmp_path / "capture" / "events.h5"
    path.parent.mkdir()
    assert cache_folder(path) == path.parent / "cache"
    monkeypatch.setattr(disk_cache.os, "access", lambda folder, _: folder != path.parent)
    monkeypatch.setattr(disk_cache.Path, "home", lambda: tmp_path / "home")
    assert cache_folder(path).is_relative_to(tmp_path / "home" / ".cache" / "sharpfield")
