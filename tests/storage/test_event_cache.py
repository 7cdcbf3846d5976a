import os
from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.events.index import build_index
from sharpfield.storage import disk_cache, event_cache
from sharpfield.storage.event_cache import (
    event_index,
    open_index,
    read_events,
    site_ranges,
    write_index,
)
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import write_events

COLUMNS = ("x", "y", "t_us", "p")


@pytest.fixture
def path(tmp_path, some_events):
    write_events(tmp_path / "events.h5", some_events(4_000))
    return tmp_path / "events.h5"


def mapped(path, **options):
    with open_events(path) as file:
        return read_events(file, in_memory=10, **options)


@pytest.mark.parametrize("between", [None, (20_000, 60_000), (0, 10**7), (10**7, 2 * 10**7)])
def test_mapped_and_loaded_events_are_the_same(path, between):
    with open_events(path) as file:
        loaded = read_events(file, between=between)
    found = mapped(path, between=between)
    assert isinstance(found.t_us, np.memmap)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(found, name), getattr(loaded, name))
        assert getattr(found, name).dtype == getattr(loaded, name).dtype


def test_the_cameras_of_a_rig_are_mapped_too(tmp_path, some_events):
    events = some_events(4_000)
    events = replace(events, track=(events.t_us % 3).astype(np.uint16), tracks=3)
    write_events(tmp_path / "rig.h5", events)
    found = mapped(tmp_path / "rig.h5")
    assert isinstance(found.track, np.memmap) and found.tracks == 3
    np.testing.assert_array_equal(found.track, events.track)
    assert event_index(found).tracks == 3 and event_index(found).sites == 3 * 120


def test_both_ends_are_kept(path):
    with open_events(path) as file:
        times = read_events(file).t_us
        first, last = int(times[100]), int(times[200])
        kept = read_events(file, between=(first, last)).t_us
    np.testing.assert_array_equal(kept, times[(times >= first) & (times <= last)])


def test_it_is_built_once(path):
    mapped(path)
    (column,) = (path.parent / "cache").glob("events-*/x.npy")
    before = column.stat().st_mtime_ns
    mapped(path)
    assert column.stat().st_mtime_ns == before


def test_another_file_or_window_builds_it_anew(path, some_events):
    mapped(path)
    assert len(mapped(path, between=(0, 50_000))) < 4_000
    write_events(path, some_events(3_000, seed=5))
    os.utime(path, ns=(1, 1))
    assert len(mapped(path)) == 3_000
    assert len(list((path.parent / "cache").iterdir())) == 1


def test_a_build_that_fails_leaves_nothing(path, monkeypatch):
    def fail(self):
        raise CaptureError("unsound")

    monkeypatch.setattr(event_cache.EventFile, "check", fail)
    with pytest.raises(CaptureError, match="unsound"):
        mapped(path, between=(0, 50_000))
    assert list((path.parent / "cache").iterdir()) == []


def test_the_index_of_a_mapped_stream_is_kept_beside_it(path):
    events = mapped(path)
    index, expected = event_index(events), build_index(events)
    for name in ("site_xy", "offset", "t_us", "p"):
        np.testing.assert_array_equal(getattr(index, name), getattr(expected, name))
    (folder,) = (path.parent / "cache").glob("events-*/index-*")
    assert folder.is_dir() and len(event_index(events)) == len(expected)


def test_the_index_of_a_part_is_its_own(path):
    events = mapped(path)
    assert len(event_index(events)) == 4_000
    assert len(event_index(events[:1_000])) == 1_000


def test_the_index_of_a_loaded_stream_leaves_no_files(path, some_events):
    assert len(event_index(some_events(100))) == 100
    assert not (path.parent / "cache").exists()


@pytest.mark.parametrize("home", [True, False])
def test_a_folder_that_cannot_be_written(path, monkeypatch, tmp_path, home):
    """Events are mapped from the cache of the user, or loaded if that cannot be written either."""
    monkeypatch.setattr(disk_cache.Path, "home", lambda: tmp_path / "home")
    refused = {path.parent} if home else {path.parent, tmp_path}
    (tmp_path / "home").mkdir()
    refused |= set() if home else {tmp_path / "home"}
    monkeypatch.setattr(disk_cache.os, "access", lambda folder, _: folder not in refused)
    events = mapped(path)
    assert len(events) == 4_000 and isinstance(events.t_us, np.memmap) == home
    assert len(event_index(events)) == 4_000
    assert not (path.parent / "cache").exists()


# The index on disk


@pytest.mark.parametrize("at_once", [1, 50, 10**6])
@pytest.mark.parametrize("rectified", [False, True])
def test_a_written_index_equals_the_one_in_memory(tmp_path, some_events, at_once, rectified):
    events = some_events(300)
    if rectified:
        events = replace(events, x=events.x.astype(np.float32), y=events.y + np.float32(0.25))
    write_index(events, tmp_path, at_once=at_once)
    index, stored = build_index(events), open_index(tmp_path, 1)
    for name in ("site_xy", "offset", "t_us", "p"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(index, name))


def test_the_written_index_of_a_rig_and_of_nothing(tmp_path, some_events):
    events = some_events(300)
    rig = replace(events, track=(events.t_us % 3).astype(np.uint16), tracks=3)
    for name, one in (("rig", rig), ("none", events[:0])):
        (tmp_path / name).mkdir()
        write_index(one, tmp_path / name, at_once=100)
        stored, index = open_index(tmp_path / name, one.tracks), build_index(one)
        assert len(stored) == len(index) and stored.sites == index.sites
        np.testing.assert_array_equal(stored.offset, index.offset)
        np.testing.assert_array_equal(stored.t_us, index.t_us)


def test_site_ranges_cover_all_sites_once():
    offset = np.array([0, 3, 3, 10, 11, 12])
    assert site_ranges(offset, 4) == [(0, 2), (2, 3), (3, 5)]
