from typing import Any

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour, checked, merged


def stream(**change: Any) -> EventStream:
    """Four events on a sensor of 4 x 3 pixels."""
    given: dict = {
        "x": np.array([0, 3, 1, 2], np.int16),
        "y": np.array([2, 0, 1, 1], np.int16),
        "t_us": np.array([10, 20, 20, 40], np.int64),
        "p": np.array([1, -1, -1, 1], np.int8),
        "width": 4,
        "height": 3,
    }
    return EventStream(**{**given, **change})


RECTIFIED = {
    "x": np.array([-0.6, 3.7, 1, 2], np.float32),
    "y": np.array([2.4, -0.3, 1, 1], np.float32),
}


def test_windows_tile_the_stream():
    events = stream()
    parts = [events.window(start, start + 10) for start in (10, 20, 30, 40)]
    assert [len(part) for part in parts] == [1, 2, 0, 1]
    assert np.concatenate([part.t_us for part in parts]).tolist() == events.t_us.tolist()


def test_a_window_keeps_its_start_and_leaves_out_its_end():
    assert stream().window(20, 40).x.tolist() == [3, 1]
    assert len(stream().window(20, 20)) == 0
    assert len(stream().window(-5, 100)) == 4


def test_slices_are_views():
    events = stream()
    assert np.shares_memory(events[1:3].t_us, events.t_us)
    assert events[1:3].p.tolist() == [-1, -1]
    assert (events[1:3].width, events[1:3].height) == (4, 3)


def test_what_coordinates_mean():
    sites = SiteColour(*RECTIFIED.values(), channel=np.array([0, 1, 1, 2], np.int8))
    assert not stream().rectified and not stream().coloured
    assert stream(**RECTIFIED).rectified
    assert stream(bayer="RGGB").coloured
    assert stream(**RECTIFIED, site_colour=sites).coloured


@pytest.mark.parametrize("change", [{}, RECTIFIED])
def test_a_sound_stream_passes(change: dict):
    events = stream(**change)
    assert checked(events, "events.h5") is events


def test_no_events_are_sound():
    assert len(checked(stream()[:0], "events.h5")) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"t_us": np.array([10, 30, 20, 15], np.int64)},
            "CaptureError: event times are not ascending\n"
            "  where  events.h5\n"
            "  got    event 1 at 30 us, event 2 at 20 us (2 steps back in all)\n"
            "  do     sort the events by time (stable), and check that clock wraps were undone",
        ),
        (
            {"p": np.array([1, 0, 1, 0], np.int8)},
            "CaptureError: polarity must be -1 or +1\n"
            "  where  events.h5, event 1\n"
            "  got    0\n"
            "  do     map 0 to -1 when reading",
        ),
        (
            {"x": np.array([0, 3, 4, 2], np.int16)},
            "CaptureError: events lie outside the sensor\n"
            "  where  events.h5\n"
            "  got    x from 0 to 4, sensor size 4\n"
            "  do     check the sensor size, and whether the file counts pixels from 1",
        ),
        (
            {"y": np.array([-1, 0, 0, 0], np.int16)},
            "CaptureError: events lie outside the sensor\n"
            "  where  events.h5\n"
            "  got    y from -1 to 0, sensor size 3\n"
            "  do     check the sensor size, and whether the file counts pixels from 1",
        ),
        (
            {**RECTIFIED, "y": np.array([0, 0, np.nan, 0], np.float32)},
            "CaptureError: event coordinate y is not a finite number\n"
            "  where  events.h5, event 2\n"
            "  got    nan\n"
            "  do     drop these events when converting",
        ),
    ],
)
def test_unsound_streams_are_refused(change: dict, message: str):
    with pytest.raises(CaptureError) as refused:
        checked(stream(**change), "events.h5")
    assert str(refused.value) == message


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int16, np.int32])
def test_any_integer_names_a_pixel(kind: type):
    events = stream(x=np.array([0, 3, 1, 2], kind), y=np.array([2, 0, 1, 1], kind))
    assert checked(events, "events.h5") is events


def test_columns_of_different_lengths_are_refused():
    events = stream()
    object.__setattr__(events, "p", events.p[:1])  # the tests' own type checks would come first
    with pytest.raises(CaptureError) as refused:
        checked(events, "events.h5")
    assert str(refused.value) == (
        "CaptureError: event columns have different lengths\n"
        "  where  events.h5\n"
        "  got    x 4, y 4, t 4, p 1\n"
        "  do     the file may be truncated: copy or convert it again"
    )


# Several cameras


def rig(*tracks: int) -> EventStream:
    return stream(track=np.array(tracks, np.uint16), tracks=3)


def test_the_streams_of_cameras_add_up_to_the_rigs():
    events = rig(2, 0, 2, 0)
    parts = [events.of_track(k) for k in range(3)]
    assert [len(part) for part in parts] == [2, 0, 2]
    assert parts[2].t_us.tolist() == [10, 20] and parts[2].track.tolist() == [2, 2]
    again = merged(parts[::-1])
    for name in ("x", "y", "t_us", "p", "track"):
        expected = getattr(events, name)[[0, 2, 1, 3]]  # at 20 us track 2 was given first
        assert getattr(again, name).tolist() == expected.tolist()
    assert again.tracks == 3


def test_a_lone_camera_is_track_0():
    assert len(stream().of_track(0)) == 4 and len(stream().of_track(1)) == 0


def test_windows_keep_the_tracks():
    assert rig(2, 0, 1, 0).window(20, 40).track.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tracks": 2}, "must say which one reported"),
        ({"track": np.array([0, 1, 2, 0], np.uint16), "tracks": 2}, "tracks 0 to 2 .* 2 known"),
        ({"track": np.array([0, -1, 0, 0], np.int16)}, "belongs to no known track"),
    ],
)
def test_unsound_tracks_are_refused(change: dict, message: str):
    with pytest.raises(CaptureError, match=message):
        checked(stream(**change), "rig.h5")
