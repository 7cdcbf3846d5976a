"""Events of a window, counted at every pixel."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.events import EventStream, SiteColour
from sharpfield.events.counts import EventMotion, counts_between
from sharpfield.events.log_path import change_between, pixel_spread, site_spread
from sharpfield.events.threshold import FixedThresholds

WIDTH, HEIGHT = 6, 5
RGGB = np.array([0, 1, 1, 2], np.int8)


def stream(n: int = 400) -> EventStream:
    """Many events share a time, so that the ends of windows matter."""
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, WIDTH, n).astype(np.int16), rng.integers(0, HEIGHT, n).astype(np.int16)
    t_us = np.sort(rng.integers(0, 100, n))
    p = (rng.integers(0, 2, n) * 2 - 1).astype(np.int8)
    return EventStream(x, y, t_us, p, WIDTH, HEIGHT)


def mono() -> EventMotion:
    return EventMotion(stream(), pixel_spread(width=WIDTH, height=HEIGHT), None)


def rectified() -> EventMotion:
    events = stream()
    x, y = events.x + np.float32(0.25), events.y - np.float32(0.5)
    return EventMotion(replace(events, x=x, y=y), pixel_spread(width=WIDTH, height=HEIGHT), None)


def bayer() -> EventMotion:
    events = replace(stream(), bayer="RGGB")
    y, x = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    sites = np.stack([x, y], -1).astype(np.float32)
    spread = site_spread(sites, RGGB[2 * (y % 2) + x % 2], width=WIDTH, height=HEIGHT)
    return EventMotion(events, spread, RGGB[2 * (events.y % 2) + events.x % 2])


KINDS = {"mono": mono, "rectified": rectified, "bayer": bayer}
kinds = pytest.mark.parametrize("kind", KINDS)


@kinds
def test_counts_add_over_time(kind: str) -> None:
    motion = KINDS[kind]()
    whole, left, right = (
        counts_between(motion, start, end) for start, end in ((5, 90), (5, 50), (50, 90))
    )
    for both, one, other in zip(whole, left, right, strict=True):
        torch.testing.assert_close(both, one + other)


@kinds
def test_darker_is_negative_and_brighter_positive(kind: str) -> None:
    negative, positive = counts_between(KINDS[kind](), 5, 90)
    assert negative.max() <= 0 <= positive.min() and negative.any() and positive.any()


@pytest.mark.parametrize("window", [(5, 90), (50, 50), (-9, 0), (-9, 999), (99, 999)])
def test_counts_are_those_of_a_loop(window: tuple[int, int]) -> None:
    motion, (start, end) = mono(), window
    events = motion.events
    expected = np.zeros((2, HEIGHT, WIDTH))
    for x, y, t, p in zip(events.x, events.y, events.t_us, events.p, strict=True):
        if start < t <= end:
            expected[int(p > 0), y, x] += p
    negative, positive = counts_between(motion, start, end)
    assert np.array_equal(negative[..., 0], expected[0])
    assert np.array_equal(positive[..., 0], expected[1])


@kinds
def test_with_thresholds_they_are_the_change_of_log_light(kind: str) -> None:
    motion = KINDS[kind]()
    negative, positive = counts_between(motion, 5, 90)
    change = change_between(
        motion.events, (5, 90), FixedThresholds(0.3, 0.2), motion.spread, channel=motion.channel
    )
    assert negative.shape[-1] == (3 if kind == "bayer" else 1)
    torch.testing.assert_close(0.3 * negative + 0.2 * positive, change)


def test_rectified_colours_count_at_their_sites() -> None:
    """A site on a pixel's centre counts there in full, and for its own colour alone."""
    sites = SiteColour(*np.array([[1.0, 4.0], [2.0, 2.0]], np.float32), np.array([0, 2], np.int8))
    x, y = np.array([4.0, 4.0, 1.0], np.float32), np.full(3, 2.0, np.float32)
    events = EventStream(
        x, y, np.array([1, 2, 3]), np.array([1, 1, -1], np.int8), WIDTH, HEIGHT, site_colour=sites
    )
    spread = site_spread(
        np.stack([sites.x, sites.y], -1), sites.channel, width=WIDTH, height=HEIGHT
    )
    motion = EventMotion(events, spread, np.array([2, 2, 0], np.int8))
    negative, positive = counts_between(motion, 0, 9)
    assert positive[2, 4].tolist() == pytest.approx([0, 0, 2])
    assert negative[2, 1].tolist() == pytest.approx([-1, 0, 0])


def test_no_events_count_nothing() -> None:
    motion = replace(mono(), events=stream()[:0])
    negative, positive = counts_between(motion, 0, 100)
    assert negative.shape == positive.shape == (HEIGHT, WIDTH, 1)
    assert not negative.any() and not positive.any()
