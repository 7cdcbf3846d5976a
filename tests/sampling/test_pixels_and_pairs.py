from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.core.frames import Exposure, Frames
from sharpfield.events.index import build_index
from sharpfield.geometry.trajectory import Still
from sharpfield.sampling.pixels_and_pairs import (
    draw_chains,
    draw_pairs,
    draw_pixels,
    draw_silent,
    pair_table,
    pixel_table,
)

WIDTH, HEIGHT, SPAN_US = 5, 4, 10_000


def stream(n=300, *, seed=0, rectified=False, bayer=""):
    random = np.random.default_rng(seed)
    x, y = random.integers(0, WIDTH, n), random.integers(0, HEIGHT, n)
    t_us = np.sort(random.integers(0, SPAN_US, n))
    p = (2 * random.integers(0, 2, n) - 1).astype(np.int8)
    if rectified:
        place = (x * 1.25 - 0.5).astype(np.float32), (y * 1.5).astype(np.float32)
    else:
        place = x.astype(np.int16), y.astype(np.int16)
    return EventStream(*place, t_us, p, WIDTH, HEIGHT, bayer=bayer)


def capture(*, events=None, frames=3, test=(0,), dtype=np.uint8):
    high = np.iinfo(dtype).max
    images = np.random.default_rng(1).integers(0, high, (frames, HEIGHT, WIDTH, 3)).astype(dtype)
    start = np.arange(frames) * 3000
    every = np.arange(frames)
    return Capture(
        camera=Camera(WIDTH, HEIGHT, 5.0, 5.0, 2.5, 2.0),
        trajectory=Still(np.eye(3, 4)[None]),
        clock=Clock(0, SPAN_US),
        near=1.0,
        far=2.0,
        frames=Frames(images, Exposure(start, start + 1000), 0 * every, tuple(map(str, every))),
        events=events,
        split=Split(every[~np.isin(every, test)], np.array(test, np.int64)),
    )


def table_of(events, **options):
    return pair_table(capture(events=events), build_index(events), **options)


def rows(struct, *names):
    """Comparable tuples of some fields of a struct."""
    columns = [getattr(struct, name).double().reshape(len(struct), -1) for name in names]
    return [tuple(row) for row in torch.cat(columns, -1).round(decimals=6).tolist()]


def slow_pairs(events, span=1):
    """Every event and the one `span` later at its pixel, by looping over the stream."""
    history, found = {}, []
    for x, y, t, p in zip(events.x, events.y, events.t_us, events.p, strict=True):
        past = history.setdefault((x, y), [])
        past.append((t, p))
        if len(past) > span:
            since = [p for _, p in past[-span:]]
            negative, positive = -since.count(-1), since.count(1)
            start, end = past[-span - 1][0] / SPAN_US, t / SPAN_US
            found.append((x + 0.5, y + 0.5, start, end, negative, positive))
    return found


PAIR = ("xy", "start", "end", "negative", "positive")


# -- pixels


def test_an_epoch_sees_every_training_pixel_once():
    table = pixel_table(capture())
    assert len(table) == 2 * WIDTH * HEIGHT
    batches = [draw_pixels(table, 8, seed=3, step=step) for step in range(5)]
    seen = [row for batch in batches for row in rows(batch, "xy", "frame")]
    expected = {(x + 0.5, y + 0.5, f) for x in range(5) for y in range(4) for f in (1, 2)}
    assert len(seen) == len(expected)
    assert set(seen) == expected


def test_epochs_steps_and_seeds_have_their_own_order():
    table = pixel_table(capture())
    first = rows(draw_pixels(table, 8, seed=3, step=0), "xy", "frame")
    for seed, step in [(3, 1), (3, 5), (4, 0)]:
        assert rows(draw_pixels(table, 8, seed=seed, step=step), "xy", "frame") != first
    assert rows(draw_pixels(table, 8, seed=3, step=0), "xy", "frame") == first


def test_an_incomplete_batch_is_dropped():
    table = pixel_table(capture())  # 40 pixels: 2 batches of 15, then another epoch
    batches = [rows(draw_pixels(table, 15, seed=0, step=s), "xy", "frame") for s in range(3)]
    assert not set(batches[0]) & set(batches[1])
    assert set(batches[2]) & (set(batches[0]) | set(batches[1]))
    assert len(draw_pixels(table, 1000, seed=0, step=7)) == 40


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pixels_carry_what_the_frame_holds(dtype):
    scene = capture(dtype=dtype)
    seen = draw_pixels(pixel_table(scene), 40, seed=0, step=0)
    column, row = seen.xy.long().unbind(-1)
    stored = scene.frames.images[seen.frame.numpy(), row.numpy(), column.numpy()]
    np.testing.assert_allclose(seen.value, stored / np.iinfo(dtype).max, rtol=1e-6)
    np.testing.assert_allclose(seen.open, seen.frame * 0.3, rtol=1e-6)
    np.testing.assert_allclose(seen.middle, seen.frame * 0.3 + 0.05, rtol=1e-6)
    assert (seen.track == 0).all()


def test_other_images_may_be_looked_at_instead():
    scene = capture()
    deblurred = scene.frames.images / np.float32(255) + np.float32(1)
    ours = draw_pixels(pixel_table(scene), 9, seed=0, step=4)
    theirs = draw_pixels(pixel_table(scene, images=deblurred), 9, seed=0, step=4)
    torch.testing.assert_close(theirs.value, ours.value + 1)
    torch.testing.assert_close(theirs.xy, ours.xy)


def test_nothing_to_learn_from_is_told():
    with pytest.raises(CaptureError, match="no frame is left to learn from"):
        pixel_table(capture(test=(0, 1, 2)))


# -- pairs


def test_an_epoch_sees_every_event_with_its_successor_once():
    events = stream()
    table = table_of(events)
    expected = slow_pairs(events)
    assert len(table) == len(expected)
    seen = rows(draw_pairs(table, len(table), seed=5, step=2), *PAIR)
    np.testing.assert_allclose(sorted(seen), sorted(expected), atol=1e-6)


def test_the_second_event_of_a_pair_gives_its_polarity():
    zero = np.zeros(3, np.int16)
    polarity = np.array([1, -1, 1], np.int8)
    events = EventStream(zero, zero, np.array([10, 20, 30]), polarity, WIDTH, HEIGHT)
    seen = draw_pairs(table_of(events), 2, seed=0, step=0)
    order = seen.start.argsort()
    assert seen.negative[order].tolist() == [-1, 0]
    assert seen.positive[order].tolist() == [0, 1]
    measured = seen.measured(0.2, 0.3)[order]
    torch.testing.assert_close(measured, torch.tensor([-0.2, 0.3]))


@pytest.mark.parametrize("span", [1, 2, 3])
def test_accumulating_a_fixed_number_of_events(span):
    events = stream()
    table = table_of(events, successors=span + 1)
    every = {tuple(np.round(np.float32(row), 5)) for row in slow_pairs(events, span)}
    seen = draw_pairs(table, len(table), seed=1, step=0, accumulate=(span, span))
    assert {tuple(np.round(np.float32(row), 5)) for row in rows(seen, *PAIR)} <= every
    assert (seen.positive - seen.negative == span).all()


def test_accumulating_a_range_of_events():
    events = stream(2000)
    table = table_of(events, successors=3)
    seen = draw_pairs(table, len(table), seed=1, step=0, accumulate=(2, 6))
    span = (seen.positive - seen.negative).long()
    counts = torch.bincount(span, minlength=8)
    assert (counts[2:7] > 0).all()
    assert counts[:2].sum() == counts[7:].sum() == 0
    # Rounding gives the two ends half the share of the others.
    assert counts[2] < 0.75 * counts[4]


def test_a_table_for_fewer_successors_cannot_accumulate_more():
    with pytest.raises(AssertionError, match="table of 1 successors"):
        draw_pairs(table_of(stream()), 4, seed=0, step=0, accumulate=(2, 3))


def test_pairs_of_a_rig_stay_with_their_camera():
    events = stream(600)
    track = np.random.default_rng(3).integers(0, 3, 600).astype(np.uint16)
    events = replace(events, track=track, tracks=3)
    table = table_of(events)
    drawn = draw_pairs(table, len(table), seed=0, step=0)
    for camera in range(3):
        mine = table_of(replace(events.of_track(camera), track=None, tracks=1))
        alone = draw_pairs(mine, len(mine), seed=0, step=0)
        names = ("xy", "start", "end", "negative", "positive")
        part = rows(drawn[drawn.track == camera], *names)
        assert sorted(part) == sorted(rows(alone, *names))


def test_chains_are_consecutive():
    events = stream()
    seen = draw_chains(table_of(events, successors=4), 16, 4, seed=0, step=0)
    assert seen.shape == (16, 4)
    torch.testing.assert_close(seen.end[:, :-1], seen.start[:, 1:])
    assert (seen.xy == seen.xy[:, :1]).all()
    every = {tuple(np.round(np.float32(row), 5)) for row in slow_pairs(events)}
    assert {tuple(np.round(np.float32(row), 5)) for row in rows(seen.reshape(-1), *PAIR)} <= every


def test_silent_pairs_have_no_event_between_them():
    events = stream(60)
    seen = draw_silent(table_of(events), 2000, seed=0, step=0)
    assert (seen.start <= seen.end).all()
    assert (seen.negative == 0).all() and (seen.positive == 0).all()
    start, end = (np.rint(time.double().numpy() * SPAN_US) for time in (seen.start, seen.end))
    column, row = seen.xy.long().unbind(-1)
    for x, y, t in zip(events.x, events.y, events.t_us, strict=True):
        here = (column.numpy() == x) & (row.numpy() == y)
        assert not (here & (start < t) & (t <= end)).any()
    assert (end - start).max() > SPAN_US / 5
    assert len(set(rows(seen, "xy"))) == WIDTH * HEIGHT


def test_bayer_tiles_name_the_colour_of_each_pixel():
    seen = draw_pairs(table_of(stream(bayer="RGGB")), 200, seed=0, step=0)
    for (x, y), channel in zip(seen.xy.long().tolist(), seen.channel.tolist(), strict=True):
        assert channel == {(0, 0): 0, (1, 0): 1, (0, 1): 1, (1, 1): 2}[x % 2, y % 2]


def test_a_mono_sensor_has_no_channel():
    assert draw_pairs(table_of(stream()), 4, seed=0, step=0).channel is None


def coloured(change=lambda x, y, channel: (x, y, channel)):
    """A rectified stream with the colours of its sites."""
    events = stream(rectified=True)
    places = sorted(set(zip(events.x.tolist(), events.y.tolist(), strict=True)))
    x, y = np.array(places, np.float32).T
    channel = (np.arange(len(x)) % 3).astype(np.int8)
    fields = {name: getattr(events, name) for name in ("x", "y", "t_us", "p", "width", "height")}
    return EventStream(**fields, site_colour=SiteColour(*change(x, y, channel))), places


def test_rectified_positions_find_their_colour():
    events, places = coloured()
    seen = draw_pairs(table_of(events), 200, seed=0, step=0)
    for place, channel in zip((seen.xy - 0.5).tolist(), seen.channel.tolist(), strict=True):
        assert channel == places.index(tuple(place)) % 3


def test_the_half_pixel_of_rectified_positions_is_an_option():
    events = stream(rectified=True)
    ours = draw_pairs(table_of(events), 50, seed=0, step=0)
    released = draw_pairs(table_of(events, half_pixel=False), 50, seed=0, step=0)
    torch.testing.assert_close(ours.xy, released.xy + 0.5)
    integer = draw_pairs(table_of(stream(), half_pixel=False), 50, seed=0, step=0)
    assert (integer.xy % 1 == 0.5).all()


def test_sites_without_or_with_two_colours_are_refused():
    missing, _ = coloured(lambda x, y, channel: (x[1:], y[1:], channel[1:]))
    with pytest.raises(CaptureError, match="has no colour"):
        table_of(missing)
    twice, _ = coloured(
        lambda x, y, channel: (
            np.append(x, x[3]),
            np.append(y, y[3]),
            np.append(channel, (channel[3] + 1) % 3).astype(np.int8),
        )
    )
    with pytest.raises(CaptureError, match="has two colours"):
        table_of(twice)
    with pytest.raises(CaptureError, match="tile is four letters"):
        table_of(stream(bayer="RGBW"))


def test_too_few_events_are_told():
    with pytest.raises(CaptureError) as told:
        table_of(stream(30), successors=20)
    assert str(told.value) == (
        "CaptureError: no event has 20 later event(s) at its pixel\n"
        "  where  capture\n"
        "  got    30 events on 20 pixels\n"
        "  do     use more events, or shorter chains"
    )
