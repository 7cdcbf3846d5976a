import importlib.util

import h5py
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.storage import event_writer, hdf5
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import write_events, writing_events


def read(path):
    with open_events(path) as file:
        return read_events(file)


def expect_same(a: EventStream, b: EventStream):
    for name in ("x", "y", "t_us", "p"):
        one, other = getattr(a, name), getattr(b, name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert (a.width, a.height, a.bayer) == (b.width, b.height, b.bayer)


@pytest.mark.parametrize("kind", [np.uint16, np.int16, np.float32, np.float64])
def test_what_is_written_is_read(tmp_path, some_events, kind):
    events = some_events(3_000)
    shift = 0.25 if np.issubdtype(kind, np.floating) else 0
    events = EventStream(
        (events.x + shift).astype(kind), events.y.astype(kind), events.t_us, events.p, 12, 10
    )
    write_events(tmp_path / "events.h5", events)
    expect_same(read(tmp_path / "events.h5"), events)


def test_pieces_make_the_same_file_as_the_whole(tmp_path, some_events):
    events = some_events(3_000)
    write_events(tmp_path / "whole.h5", events)
    with writing_events(tmp_path / "pieces.h5", events[:0]) as writer:
        for first in range(0, 3_000, 700):
            writer.append(events[first : first + 700])
        writer.append(events[:0])
    expect_same(read(tmp_path / "pieces.h5"), read(tmp_path / "whole.h5"))
    with h5py.File(tmp_path / "pieces.h5") as a, h5py.File(tmp_path / "whole.h5") as b:
        np.testing.assert_array_equal(a["ms_to_idx"][:], b["ms_to_idx"][:])


def test_the_index_of_ms_obeys_dsecs_two_inequalities(tmp_path, some_events):
    events = some_events(500)  # about 5 per ms, with gaps
    write_events(tmp_path / "events.h5", events)
    with h5py.File(tmp_path / "events.h5") as file:
        t, marks = file["events/t"][:].astype(np.int64), file["ms_to_idx"][:].astype(np.int64)
    assert len(marks) == t[-1] // 1000 + 1
    for ms, first in enumerate(marks):
        assert t[first] >= 1000 * ms
        assert first == 0 or t[first - 1] < 1000 * ms


def test_long_and_negative_times(tmp_path, some_events):
    events = some_events(4)
    for times in ([-5_001, -5_000, 0, 7], [0, 1, 2**32 - 1, 2**32 + 5]):
        moved = EventStream(events.x, events.y, np.array(times), events.p, 12, 10)
        if times[-1] > 2**32:  # ms_to_idx of 71 minutes would be 4 M entries: written all the same
            assert moved.t_us[-1] - moved.t_us[0] > event_writer.SHORT_US
        write_events(tmp_path / "events.h5", moved)
        expect_same(read(tmp_path / "events.h5"), moved)


def test_colours_of_rectified_sites_are_kept(tmp_path, some_events):
    sites = SiteColour(np.float32([0.5, 1.5]), np.float32([2.5, 3.5]), np.array([0, 2], np.int8))
    plain = some_events(10)
    events = EventStream(
        plain.x.astype(np.float32),
        plain.y.astype(np.float32),
        plain.t_us,
        plain.p,
        12,
        10,
        bayer="RGGB",
        site_colour=sites,
    )
    write_events(tmp_path / "events.h5", events)
    found = read(tmp_path / "events.h5")
    expect_same(found, events)
    for name in ("x", "y", "channel"):
        np.testing.assert_array_equal(getattr(found.site_colour, name), getattr(sites, name))
        assert getattr(found.site_colour, name).dtype == getattr(sites, name).dtype


def test_no_events(tmp_path, some_events):
    write_events(tmp_path / "events.h5", some_events(3)[:0])
    found = read(tmp_path / "events.h5")
    assert len(found) == 0 and (found.width, found.height) == (12, 10)


def test_without_the_plugin_it_is_gzip(tmp_path, some_events, monkeypatch):
    monkeypatch.setattr(hdf5.importlib.util, "find_spec", lambda name: None)
    write_events(tmp_path / "events.h5", some_events(100))
    with h5py.File(tmp_path / "events.h5") as file:
        assert file["events/t"].compression == "gzip" and file["events/t"].shuffle
    expect_same(read(tmp_path / "events.h5"), some_events(100))


def test_with_the_plugin_it_is_blosc(tmp_path, some_events):
    if importlib.util.find_spec("hdf5plugin") is None:
        pytest.skip("hdf5plugin is not installed")
    write_events(tmp_path / "events.h5", some_events(100))
    with h5py.File(tmp_path / "events.h5") as file:
        assert file["events/t"].id.get_create_plist().get_filter(0)[0] == hdf5.BLOSC


def test_a_block_that_fails_leaves_the_old_file(tmp_path, some_events):
    write_events(tmp_path / "events.h5", some_events(5))
    with pytest.raises(KeyboardInterrupt):
        with writing_events(tmp_path / "events.h5", some_events(1)) as writer:
            writer.append(some_events(50))
            raise KeyboardInterrupt
    expect_same(read(tmp_path / "events.h5"), some_events(5))
    assert [path.name for path in tmp_path.iterdir()] == ["events.h5"]


def test_chunks_out_of_order_are_refused(tmp_path, some_events):
    events = some_events(100)
    with pytest.raises(CaptureError, match="begin before the last ones"):
        with writing_events(tmp_path / "events.h5", events) as writer:
            writer.append(events[50:])
            writer.append(events[:50])
    assert not (tmp_path / "events.h5").exists()


def test_more_than_announced_is_refused(tmp_path, some_events):
    events = some_events(2)
    late = EventStream(events.x, events.y, np.array([0, 2**33]), events.p, 12, 10)
    with pytest.raises(CaptureError, match="longer than"):
        with writing_events(tmp_path / "events.h5", events, span_us=1_000) as writer:
            writer.append(late)
