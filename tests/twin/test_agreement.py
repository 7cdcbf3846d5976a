import math
from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.twin.agreement import busiest_window, compare_events
from tests.evaluation.fake import random_events

EDGES = [0, 400_000, 700_000, 1_000_001]


def test_a_stream_agrees_with_itself():
    events = random_events(3000)
    found = compare_events(events, events, EDGES)
    assert (found.predicted, found.recorded, found.count_ratio) == (3000, 3000, 1.0)
    assert found.pixel_correlation == pytest.approx(1)
    assert (found.count_error, found.sign_iou, found.frame_psnr) == (0, 1, math.inf)
    assert (found.timing_ms, found.timed_share) == (0, 1)


def test_nothing_predicted_is_the_floor():
    events = random_events(3000)
    found = compare_events(events[:0], events, EDGES)
    assert (found.count_ratio, found.count_error, found.sign_iou) == (0, 1, 0)
    assert found.frame_psnr == found.empty_psnr < math.inf
    assert math.isnan(found.timing_ms) and found.timed_share == 0


def test_the_opposite_sign_is_no_agreement():
    events = random_events(3000)
    found = compare_events(replace(events, p=-events.p), events, EDGES)
    assert found.count_ratio == 1 and found.sign_iou == 0 and found.count_error > 1


def test_timing_against_a_slow_loop():
    mine, theirs = random_events(400), random_events(250)
    theirs = replace(theirs, t_us=np.sort(theirs.t_us[::-1] // 2 + 7))
    found = compare_events(mine, theirs, [0, 1_000_001])
    away = []
    for x, y, t, p in zip(theirs.x, theirs.y, theirs.t_us, theirs.p, strict=True):
        alike = (mine.x == x) & (mine.y == y) & (mine.p == p)
        away += [np.abs(mine.t_us[alike] - t).min()] if alike.any() else []
    assert found.timed_share == len(away) / 250 and 20 < len(away) < 230
    assert found.timing_ms == pytest.approx(np.median(away) / 1000)


def test_only_what_lies_within_counts_also_on_clocks_that_began_long_ago():
    events = random_events(3000)
    late = replace(events, t_us=events.t_us + 1_700_000_000_000_000)
    edges = [1_700_000_000_000_000 + t for t in (300_000, 500_000)]
    found = compare_events(late, late, edges)
    inside = ((events.t_us >= 300_000) & (events.t_us < 500_000)).sum()
    assert (found.recorded, found.timing_ms) == (inside, 0)


def test_rectified_positions_count_at_the_nearest_pixel():
    events = random_events(2000)
    shifted = replace(events, x=events.x + np.float32(0.3), y=events.y - np.float32(0.4))
    found = compare_events(events, shifted, EDGES)
    assert (found.count_error, found.timing_ms, found.timed_share) == (0, 0, 1)


def test_the_busiest_window_is_shown_recorded_first():
    events = random_events(3000)
    image = busiest_window(events[:0], events, EDGES)
    assert image.shape == (32, 40 + 4 + 40, 3)
    assert (image[:, 40:] == 255).all() and (image[:, :40] < 255).any()


def test_what_cannot_be_compared_is_refused():
    events = random_events(30)
    with pytest.raises(OptionError, match="nothing was recorded in this time"):
        compare_events(events, events[:0], EDGES)
    with pytest.raises(OptionError, match="differ in size"):
        compare_events(replace(events, width=50), events, EDGES)
