import pytest

from sharpfield.captures.clocks import expect_overlap
from sharpfield.core.errors import CaptureError

POSES = (1_000_000, 2_200_000)


def check(events):
    expect_overlap(events, POSES, where="events.h5", known="poses", do="give the unit")


@pytest.mark.parametrize(
    "events",
    [(1_000_439, 2_199_999), (0, 10_000_000), (1_500_000, 1_600_000), (2_200_000, 2_300_000)],
)
def test_events_that_overlap_pass(events):
    check(events)


def test_ns_taken_for_us_are_recognised():
    with pytest.raises(CaptureError) as caught:
        check((1_000_438_515, 2_199_999_087))
    assert str(caught.value).splitlines() == [
        "CaptureError: events and poses were not taken at the same time",
        "  where  events.h5",
        "  got    events from 1000438515 to 2199999087 us, poses from 1000000 to 2200000 us",
        "  do     event times look like ns where us were expected: give the unit",
    ]


def test_us_taken_for_ns_are_recognised():
    with pytest.raises(CaptureError, match="event times look like us where ns were expected"):
        check((1_000, 2_200))


def test_wrong_units_are_recognised_even_where_clocks_overlap_at_zero():
    with pytest.raises(CaptureError, match="look like ns"):
        expect_overlap((0, 10**9), (0, 10**6), where="", known="poses", do="")
    with pytest.raises(CaptureError, match="look like us"):
        expect_overlap((0, 10**3), (0, 10**6), where="", known="poses", do="")


def test_another_zero_is_not_taken_for_another_unit():
    with pytest.raises(CaptureError, match="count from the same instant"):
        check((5_000_000, 6_000_000))
