from dataclasses import replace

import h5py
import numpy as np
import pytest

from sharpfield.core.events import EventStream
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import ROWS, join_events, write_events, writing_events
from tests.streams import random_events


def long_stream(count: int) -> EventStream:
    span = {"first_us": 1_000_500, "last_us": 9_000_000}
    return random_events(count, size=(20, 10), bayer="RGGB", seed=3, **span)


@pytest.mark.parametrize("cuts", [[], [ROWS], [ROWS, 3 * ROWS]])
def test_parts_joined_are_the_file_written_at_once(tmp_path, cuts):
    events = long_stream(3 * ROWS + 777)
    whole = tmp_path / "whole.h5"
    write_events(whole, events)
    parts, edges = [], [0, *cuts, len(events)]
    for i, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        parts.append(tmp_path / f"part{i}.h5")
        with writing_events(
            parts[-1], events[:0], span_us=8_000_000, origin_us=1_000_000
        ) as writer:
            writer.append(events[first:last])
    join_events(tmp_path / "joined.h5", parts)
    with h5py.File(whole) as one, h5py.File(tmp_path / "joined.h5") as other:
        assert dict(one.attrs) == dict(other.attrs)
        for name in ("events/x", "events/y", "events/t", "events/p", "ms_to_idx", "t_offset"):
            assert one[name].dtype == other[name].dtype
            np.testing.assert_array_equal(one[name][()], other[name][()], name)
    with open_events(tmp_path / "joined.h5") as file:
        window = file.window(5_000_000, 5_010_000)
        first, last = np.searchsorted(events.t_us, [5_000_000, 5_010_000])
        np.testing.assert_array_equal(window.t_us, events.t_us[first:last])


def test_parts_that_end_within_a_chunk_are_refused(tmp_path):
    events = long_stream(100)
    for i, part in enumerate((events[:50], events[50:])):
        with writing_events(tmp_path / f"{i}.h5", replace(part)[:0], origin_us=0) as writer:
            writer.append(part)
    with pytest.raises(AssertionError, match="50"):
        join_events(tmp_path / "j.h5", [tmp_path / "0.h5", tmp_path / "1.h5"])
