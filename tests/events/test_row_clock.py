"""Events on the clock of a rolling shutter."""

from dataclasses import replace

import numpy as np

from sharpfield.core.events import EventStream
from sharpfield.events.counts import subtract_row_delay
from tests.streams import random_events


def stream() -> EventStream:
    return random_events(200, size=(8, 20), first_us=0, last_us=5000)


def test_events_are_earlier_by_the_delay_of_their_row_and_in_order():
    events = stream()
    seen = subtract_row_delay(events, 100.0)
    assert (np.diff(seen.t_us) >= 0).all()
    back = list(zip(seen.t_us + 100 * seen.y.astype(int), seen.x, seen.y, seen.p, strict=True))
    assert sorted(back) == sorted(zip(events.t_us, events.x, events.y, events.p, strict=True))
    assert seen.x.dtype == events.x.dtype and seen.t_us.dtype == np.int64


def test_rows_exposed_one_after_the_other_have_the_same_events_in_one_window():
    events, opens, length = stream(), 1000, 800
    seen = subtract_row_delay(events, 100.0).window(opens, opens + length)
    for row in range(20):
        mine = events.t_us[events.y == row]
        late = opens + 100 * row
        assert (seen.y == row).sum() == ((mine >= late) & (mine < late + length)).sum()


def test_a_global_shutter_changes_nothing():
    events = stream()
    assert subtract_row_delay(events, 0.0) is events
    assert len(subtract_row_delay(events[:0], 100.0)) == 0


def test_tracks_stay_with_their_events():
    events = stream()
    track = np.arange(len(events), dtype=np.int32)
    seen = subtract_row_delay(replace(events, track=track, tracks=len(events)), 100.0)
    assert seen.track is not None
    np.testing.assert_array_equal(events.p[seen.track], seen.p)
    np.testing.assert_array_equal(events.y[seen.track], seen.y)
