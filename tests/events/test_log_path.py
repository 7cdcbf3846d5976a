"""Paths of log light: exact between events, interpolated between colours."""

import math

import numpy as np
import pytest
import torch

from sharpfield.core.events import EventStream
from sharpfield.events.log_path import change_between, exposure_path, pixel_spread, site_spread
from sharpfield.events.threshold import FixedThresholds

WIDTH, HEIGHT = 6, 5
THRESHOLDS = FixedThresholds(negative=0.3, positive=0.2)
RGGB = np.array([0, 1, 1, 2], np.int8)


def stream(n: int = 300, seed: int = 0, *, rectified: bool = False) -> EventStream:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    x, y = (x.astype(np.int16), y.astype(np.int16))
    if rectified:
        x, y = x + np.float32(0.25), y - np.float32(0.5)
    t_us = np.sort(rng.choice(1000, n, replace=False))
    p = (rng.integers(0, 2, n) * 2 - 1).astype(np.int8)
    return EventStream(x, y, t_us, p, WIDTH, HEIGHT)


def tile(events: EventStream) -> np.ndarray:
    return RGGB[2 * (events.y % 2) + events.x % 2]


def grid() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    return np.stack([x, y], -1).astype(np.float32), RGGB[2 * (y % 2) + x % 2]


def test_exact_path_matches_a_walk_through_every_microsecond() -> None:
    events, (opens, closes) = stream(), (100, 900)
    middle = 487
    found = exposure_path(
        events,
        (opens, closes),
        np.array([middle]),
        THRESHOLDS,
        pixel_spread(width=WIDTH, height=HEIGHT),
    )
    level = np.zeros((HEIGHT, WIDTH))
    total = np.zeros_like(level)
    at_middle = None
    for t in range(opens, closes):  # light during [t, t + 1)
        for i in np.flatnonzero((events.t_us == t) & (events.t_us > opens)):
            level[events.y[i], events.x[i]] += 0.2 if events.p[i] > 0 else -0.3
        if t == middle:
            at_middle = level.copy()
        total += np.exp(level)
    np.testing.assert_allclose(found.change[0, ..., 0], at_middle, atol=1e-6)
    np.testing.assert_allclose(found.log_mean[..., 0], np.log(total / (closes - opens)), atol=1e-6)


@pytest.mark.parametrize("rectified", [False, True])
def test_changes_add_over_time(rectified: bool) -> None:
    events, spread = stream(rectified=rectified), pixel_spread(width=WIDTH, height=HEIGHT)
    whole, left, right = (
        change_between(events, window, THRESHOLDS, spread)
        for window in ((100, 800), (100, 444), (444, 800))
    )
    torch.testing.assert_close(whole, left + right)


def test_change_at_an_instant_is_the_change_from_the_opening() -> None:
    events, spread = stream(), pixel_spread(width=WIDTH, height=HEIGHT)
    path = exposure_path(events, (100, 900), np.array([100, 300, 900]), THRESHOLDS, spread)
    assert not path.change[0].any()
    torch.testing.assert_close(
        path.change[1], change_between(events, (100, 300), THRESHOLDS, spread)
    )
    torch.testing.assert_close(
        path.change[2], change_between(events, (100, 900), THRESHOLDS, spread)
    )


def test_a_still_pixel_and_an_instant_have_no_path() -> None:
    events, spread = stream(), pixel_spread(width=WIDTH, height=HEIGHT)
    still = exposure_path(events[:0], (100, 900), np.array([500]), THRESHOLDS, spread)
    instant = exposure_path(events, (500, 500), np.array([500]), THRESHOLDS, spread)
    for path in (still, instant):
        assert not path.log_mean.any() and not path.change.any()


def test_rectified_event_is_shared_among_four_pixels() -> None:
    event = EventStream(
        np.array([2.25], np.float32), np.array([1.5], np.float32), np.array([5]),
        np.ones(1, np.int8), WIDTH, HEIGHT,
    )  # fmt: skip
    found = change_between(event, (0, 9), THRESHOLDS, pixel_spread(width=WIDTH, height=HEIGHT))[
        ..., 0
    ]
    expected = torch.zeros(HEIGHT, WIDTH)
    expected[1:3, 2], expected[1:3, 3] = 0.2 * 0.375, 0.2 * 0.125
    torch.testing.assert_close(found, expected)


def slow_demosaic(raw: np.ndarray, channel: int) -> np.ndarray:
    """Bilinear: the mean of the nearest pixels that see this colour."""
    colour = grid()[1].reshape(HEIGHT, WIDTH)
    found = np.zeros((HEIGHT, WIDTH))
    for y in range(HEIGHT):
        for x in range(WIDTH):
            near = []
            for reach in (0, 1, 2):  # steps of a king; green is never further than one of a rook
                for v in range(max(0, y - 1), min(HEIGHT, y + 2)):
                    for u in range(max(0, x - 1), min(WIDTH, x + 2)):
                        if abs(u - x) + abs(v - y) == reach and colour[v, u] == channel:
                            near.append(raw[v, u])
                if near:
                    break
            found[y, x] = np.mean(near)
    return found


def test_colours_are_interpolated_as_in_bilinear_demosaicing() -> None:
    events = stream()
    spread = site_spread(*grid(), width=WIDTH, height=HEIGHT)
    found = change_between(events, (0, 1000), THRESHOLDS, spread, channel=tile(events))
    mono = change_between(events, (0, 1000), THRESHOLDS, pixel_spread(width=WIDTH, height=HEIGHT))
    inner = (slice(1, -1), slice(1, -1))
    for channel in range(3):
        expected = slow_demosaic(mono[..., 0].numpy(), channel)
        np.testing.assert_allclose(found[..., channel].numpy()[inner], expected[inner], atol=1e-6)


def test_colours_that_change_alike_everywhere_change_alike_in_every_pixel() -> None:
    xy, channel = grid()
    n = len(xy)
    events = EventStream(
        xy[:, 0].astype(np.int16), xy[:, 1].astype(np.int16), np.arange(1, n + 1),
        np.ones(n, np.int8), WIDTH, HEIGHT,
    )  # fmt: skip
    spread = site_spread(xy, channel, width=WIDTH, height=HEIGHT)
    found = change_between(events, (0, n), THRESHOLDS, spread, channel=channel)
    reached = found != 0  # a corner may see no blue at all
    assert reached.float().mean() > 0.9
    torch.testing.assert_close(found[reached], torch.full_like(found[reached], 0.2))


def test_halves_of_an_exposure_average_to_the_whole() -> None:
    events, spread = stream(), pixel_spread(width=WIDTH, height=HEIGHT)
    none = np.zeros(0, np.int64)
    whole = exposure_path(events, (100, 900), none, THRESHOLDS, spread).log_mean.exp()
    first = exposure_path(events, (100, 500), none, THRESHOLDS, spread).log_mean.exp()
    second = exposure_path(events, (500, 900), none, THRESHOLDS, spread).log_mean.exp()
    moved = change_between(events, (100, 500), THRESHOLDS, spread).exp()
    torch.testing.assert_close(whole, (first + moved * second) / 2)


def test_one_step_in_the_middle_by_hand() -> None:
    event = EventStream(
        np.array([2], np.int16),
        np.array([1], np.int16),
        np.array([500]),
        -np.ones(1, np.int8),
        6,
        5,
    )
    path = exposure_path(
        event, (0, 1000), np.array([499, 500]), THRESHOLDS, pixel_spread(width=6, height=5)
    )
    assert path.change[:, 1, 2, 0].tolist() == pytest.approx([0, -0.3])
    assert path.log_mean[1, 2, 0].item() == pytest.approx(math.log((1 + math.exp(-0.3)) / 2))
