"""The pixel-major index answers as a slow walk through the time-ordered stream does."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.events import index as ops
from sharpfield.events.image import splat_bilinear, splat_nearest, window_image

WIDTH, HEIGHT = 7, 5


def stream(n: int = 600, seed: int = 0, *, rectified: bool = False) -> EventStream:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    t_us = np.sort(rng.integers(0, 500, n))  # many events share a microsecond
    p = (rng.integers(0, 2, n) * 2 - 1).astype(np.int8)
    if rectified:
        warp = rng.normal(0, 0.4, (2, HEIGHT, WIDTH)).astype(np.float32)
        x, y = (x + warp[0][y, x]).astype(np.float32), (y + warp[1][y, x]).astype(np.float32)
    else:
        x, y = x.astype(np.int16), y.astype(np.int16)
    return EventStream(x, y, t_us, p, WIDTH, HEIGHT)


def of_site(events: EventStream, xy: np.ndarray) -> np.ndarray:
    return np.flatnonzero((events.x == xy[0]) & (events.y == xy[1]))


@pytest.fixture(params=[False, True], ids=["pixels", "rectified"])
def events(request: pytest.FixtureRequest) -> EventStream:
    return stream(rectified=request.param)


def test_index_holds_each_sites_events_in_order_of_time(events: EventStream) -> None:
    index = ops.build_index(events)
    assert len(index) == len(events) and index.offset[-1] == len(events)
    for site, xy in enumerate(index.site_xy):
        here = of_site(events, xy)
        part = slice(index.offset[site], index.offset[site + 1])
        np.testing.assert_array_equal(index.t_us[part], events.t_us[here])
        np.testing.assert_array_equal(index.p[part], events.p[here])  # stable among equal times


def test_pixels_are_sites_row_by_row() -> None:
    index = ops.build_index(stream(3))
    assert index.sites == WIDTH * HEIGHT
    np.testing.assert_array_equal(index.site_xy[2 * WIDTH + 3], [3, 2])


def test_rectified_sites_are_the_distinct_positions() -> None:
    events = stream(rectified=True)
    expected = np.unique(np.stack([events.y, events.x], -1), axis=0)[:, ::-1]
    np.testing.assert_array_equal(ops.build_index(events).site_xy, expected)


def test_many_rectified_sites_outgrow_the_first_table() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.random((2, 100_000), dtype=np.float32) * 5
    n = len(x)
    events = EventStream(x, y, np.arange(n), np.ones(n, np.int8), WIDTH, HEIGHT)
    index = ops.build_index(events)
    back = ops.sites_at(index, np.stack([x, y], -1))
    assert index.sites == n
    np.testing.assert_array_equal(index.t_us[index.offset[back]], events.t_us)


def test_minus_zero_and_zero_are_one_place() -> None:
    x = np.array([0.0, -0.0], np.float32)
    events = EventStream(x, x, np.array([1, 2]), np.ones(2, np.int8), WIDTH, HEIGHT)
    assert ops.build_index(events).sites == 1


def test_sites_at_finds_exact_positions_only(events: EventStream) -> None:
    index = ops.build_index(events)
    np.testing.assert_array_equal(ops.sites_at(index, index.site_xy), np.arange(index.sites))
    assert ops.sites_at(index, index.site_xy + np.float32(0.01)).max() == -1


def test_queries_match_a_slow_loop(events: EventStream) -> None:
    index = ops.build_index(events)
    rng = np.random.default_rng(1)
    site = rng.integers(0, index.sites, 300)
    start, end = np.sort(rng.integers(-20, 520, (2, 300)), axis=0)
    after, before = ops.next_event(index, site, start), ops.previous_event(index, site, start)
    first, last = ops.window(index, site, start, end)
    darker, brighter = ops.counts(index, first, last)
    signed = ops.signed_sum(index, site, start, end)
    for i in range(300):
        here = of_site(events, index.site_xy[site[i]])
        t, p = events.t_us[here], events.p[here]
        later, earlier = np.flatnonzero(t > start[i]), np.flatnonzero(t < start[i])
        base = index.offset[site[i]]
        assert after[i] == (base + later[0] if len(later) else -1)
        assert before[i] == (base + earlier[-1] if len(earlier) else -1)
        inside = (t >= start[i]) & (t < end[i])
        assert last[i] - first[i] == inside.sum()
        assert darker[i] == (p[inside] < 0).sum() and brighter[i] == (p[inside] > 0).sum()
        assert signed[i] == p[inside].sum()


def test_windows_add_up(events: EventStream) -> None:
    index = ops.build_index(events)
    site = np.arange(index.sites)
    whole, left, right = (
        ops.signed_sum(index, site, np.full_like(site, a), np.full_like(site, b))
        for a, b in ((100, 400), (100, 233), (233, 400))
    )
    np.testing.assert_array_equal(whole, left + right)


@pytest.mark.parametrize("hops", [1, 3])
def test_chains_start_at_every_event_with_enough_successors(hops: int) -> None:
    index = ops.build_index(stream(80))
    chain = ops.chains(index, hops)
    rank = np.arange(chain[-1])
    site, position = ops.chain_start(index, chain, rank)
    expected = [
        (s, k)
        for s in range(index.sites)
        for k in range(index.offset[s], index.offset[s + 1])
        if k + hops < index.offset[s + 1]
    ]
    assert list(zip(site, position, strict=True)) == expected


def test_window_image_counts_both_signs() -> None:
    events = stream()
    image = window_image(ops.build_index(events), 100, 300, width=WIDTH, height=HEIGHT)
    expected = np.zeros((HEIGHT, WIDTH, 2))
    for x, y, t, p in zip(events.x, events.y, events.t_us, events.p, strict=True):
        expected[y, x, int(p > 0)] += 100 <= t < 300
    np.testing.assert_array_equal(image, expected)


def test_bilinear_splat_matches_a_slow_loop_and_drops_what_is_outside() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(-2, 9, (200, 2)).astype(np.float32)
    value = rng.normal(size=(200, 2))
    expected = np.zeros((HEIGHT, WIDTH, 2))
    for (x, y), v in zip(xy, value, strict=True):
        for row in range(HEIGHT):
            for column in range(WIDTH):
                near = max(0, 1 - abs(x - column)) * max(0, 1 - abs(y - row))
                expected[row, column] += near * v
    found = splat_bilinear(xy, value, width=WIDTH, height=HEIGHT)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_both_splats_agree_on_whole_coordinates() -> None:
    xy = np.array([[0, 0], [6, 4], [3, 2], [7, 0], [-1, 0]], np.float32)  # two lie outside
    value = np.arange(5.0)[:, None]
    found = splat_bilinear(xy, value, width=WIDTH, height=HEIGHT)
    np.testing.assert_array_equal(found, splat_nearest(xy, value, width=WIDTH, height=HEIGHT))
    assert found.sum() == 3 and found[4, 6] == 1


def test_nearest_splat_rounds_halves_up() -> None:
    xy = np.array([[1.5, 0.49], [-0.5, 4.4]], np.float32)
    image = splat_nearest(xy, np.ones((2, 1)), width=WIDTH, height=HEIGHT)
    assert image[0, 2] == 1 and image[4, 0] == 1


def test_empty_stream() -> None:
    for rectified in (False, True):
        none = stream(1, rectified=rectified)[:0]
        index = ops.build_index(none)
        assert len(index) == 0 and ops.chains(index)[-1] == 0
        assert window_image(index, 0, 9, width=WIDTH, height=HEIGHT).sum() == 0


def test_event_outside_the_sensor_is_refused() -> None:
    events = EventStream(
        np.array([0, 7], np.int16), np.array([0, 1], np.int16), np.array([5, 6]),
        np.ones(2, np.int8), WIDTH, HEIGHT,
    )  # fmt: skip
    with pytest.raises(CaptureError, match=re.escape("x 7, y 1, sensor 7x5")):
        ops.build_index(events)


def test_time_going_back_at_a_pixel_is_refused() -> None:
    events = EventStream(
        np.array([2, 2], np.int16), np.array([1, 1], np.int16), np.array([6, 5]),
        np.ones(2, np.int8), WIDTH, HEIGHT,
    )  # fmt: skip
    with pytest.raises(CaptureError, match="pixel x 2, y 1\n.*an event at 5 us after a later one"):
        ops.build_index(events)


# Several cameras


def rig(n: int = 900) -> EventStream:
    draw = np.random.default_rng(7)
    return replace(stream(n), track=draw.integers(0, 3, n).astype(np.uint16), tracks=3)


def test_each_camera_of_a_rig_has_the_index_of_its_own_stream() -> None:
    events = rig()
    for index in (ops.build_index(events),):
        assert index.sites == 3 * HEIGHT * WIDTH
        for track in range(3):
            own = replace(events.of_track(track), track=None, tracks=1)
            alone, sites = ops.build_index(own), index.sites_of(track)
            np.testing.assert_array_equal(index.track_of(sites), track)
            np.testing.assert_array_equal(index.site_xy[sites], alone.site_xy)
            begin, end = index.offset[sites[0]], index.offset[sites[-1] + 1]
            np.testing.assert_array_equal(index.t_us[begin:end], alone.t_us)
            np.testing.assert_array_equal(index.p[begin:end], alone.p)
            size = {"width": WIDTH, "height": HEIGHT}
            np.testing.assert_array_equal(
                window_image(index, 50, 300, track=track, **size),
                window_image(alone, 50, 300, **size),
            )


def test_sites_are_numbered_by_track_row_and_column() -> None:
    index = ops.build_index(rig())
    xy = np.array([[3, 2], [6, 4]], np.float32)
    expected = 2 * HEIGHT * WIDTH + np.array([2 * WIDTH + 3, 4 * WIDTH + 6])
    np.testing.assert_array_equal(ops.sites_at(index, xy, track=2), expected)
    np.testing.assert_array_equal(ops.sites_at(index, xy + 0.5, track=2), -1)


def test_rectified_rigs_are_refused() -> None:
    events = stream(9, rectified=True)
    with pytest.raises(CaptureError, match="must name pixels"):
        ops.build_index(replace(events, track=np.zeros(9, np.uint16), tracks=2))
