import os
from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.events.index import build
from sharpfield.storage import event_cache
from sharpfield.storage.event_cache import cache_folder, event_index, read_events
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
    column = path.parent / "cache" / "events" / "x.npy"
    before = column.stat().st_mtime_ns
    mapped(path)
    assert column.stat().st_mtime_ns == before


def test_another_file_or_window_builds_it_anew(path, some_events):
    mapped(path)
    assert len(mapped(path, between=(0, 50_000))) < 4_000
    write_events(path, some_events(3_000, seed=5))
    os.utime(path, ns=(1, 1))
    assert len(mapped(path)) == 3_000


def test_a_build_that_fails_leaves_nothing(path, monkeypatch):
    def fail(self):
        raise CaptureError("unsound")

    monkeypatch.setattr(event_cache.EventFile, "check", fail)
    with pytest.raises(CaptureError, match="unsound"):
        mapped(path, between=(0, 50_000))
    assert not (path.parent / "cache" / "events").exists()


def test_the_index_of_a_mapped_stream_is_kept_beside_it(path):
    events = mapped(path)
    index, expected = event_index(events), build(events)
    for name in ("site_xy", "offset", "t_us", "p"):
        np.testing.assert_array_equal(getattr(index, name), getattr(expected, name))
    assert (path.parent / "cache" / "events" / "index").is_dir()


def test_the_index_of_a_part_is_its_own(path):
    events = mapped(path)
    assert len(event_index(events)) == 4_000
    assert len(event_index(events[:1_000])) == 1_000


def test_the_index_of_a_loaded_stream_leaves_no_files(path, some_events):
    assert len(event_index(some_events(100))) == 100
    assert not (path.parent / "cache").exists()


def test_a_place_that_cannot_be_written_uses_the_users_cache(path, monkeypatch, tmp_path):
    assert cache_folder(path) == path.parent / "cache"
    monkeypatch.setattr(event_cache.os, "access", lambda *_: False)
    monkeypatch.setattr(event_cache.Path, "home", lambda: tmp_path / "home")
    assert cache_folder(path).is_relative_to(tmp_path / "home" / ".cache" / "sharpfield")
    assert len(mapped(path)) == 4_000
    assert not (path.parent / "cache").exists()
