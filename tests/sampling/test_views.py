"""Batches of whole views: instants, frames, latent frames, windows of events."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.measurements import Batch, EventPairs, Instants, Pixels
from sharpfield.events.latent_frames import SensorEstimate
from sharpfield.events.ramps import LONGEST_US, phase_at
from sharpfield.sampling.views import SamplingOptions, ViewSampler
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.storage.event_cache import event_index

SENSOR = SensorEstimate(0.2, 0.2)


@functools.cache
def coloured(bayer: str = "RGGB") -> Capture:
    timing = Timing(frames=4, exposure_us=20_000, interval_us=24_000, test_every=4)
    rig = Rig(size=(16, 12), event_sensor=EventSensor(bayer=bayer))
    return simulate("tiles", rig=rig, timing=timing, seed=3)


@functools.cache
def busy() -> Capture:
    """On a mono sensor whose pixels report often."""
    timing = Timing(frames=4, exposure_us=20_000, interval_us=24_000, test_every=4)
    rig = Rig(size=(16, 12), event_sensor=EventSensor(threshold_on=0.02, threshold_off=0.02))
    return simulate("garden", rig=rig, timing=timing, seed=3)


def sampler(capture: Capture, seed: int = 0, **options) -> ViewSampler:
    return ViewSampler(SamplingOptions(**options), capture, seed, steps=100)


def of(batch: Batch) -> tuple[Instants, EventPairs | None]:
    views, events = batch["views"], batch.get("events")
    assert isinstance(views, Instants) and (events is None or isinstance(events, EventPairs))
    return views, events


def same(one: Batch, other: Batch) -> bool:
    return one.keys() == other.keys() and all(
        torch.equal(getattr(one[name], field), getattr(other[name], field))
        for name in one
        for field in ("time", "weight", "value", "xy", "negative", "corner")
        if hasattr(one[name], field)
    )


@pytest.mark.parametrize("instants", [1, 2, 5])
def test_instants_of_an_exposure_ascend_within_it_and_count_for_one(tiny: Capture, instants: int):
    made = sampler(tiny, grad_views=instants)
    begin, end = (tiny.clock.unit(int(t)).item() for t in tiny.needed_events.t_us[[0, -1]])
    for step in range(12):
        batch = made.exposure_batch(step, SENSOR, events=True)
        views, _ = of(batch)
        frames = batch["frames"]
        assert isinstance(frames, Pixels) and views.shape == (1, instants + 1)
        assert (views.time.diff() >= 0).all()
        inside = views.weight > 0
        assert inside.sum() == instants and views.weight.sum().item() == pytest.approx(1)
        opens, closes = frames.open.unique().item(), frames.close.unique().item()
        assert ((views.time >= opens - 1e-6) & (views.time <= closes + 1e-6))[inside].all()
        beside = views.time[~inside].item()
        recorded = beside == pytest.approx(begin, abs=1e-6) or beside == pytest.approx(end)
        assert beside < opens or beside > closes or recorded


def test_each_instant_has_a_share_of_the_exposure_of_its_own(tiny: Capture):
    made = sampler(tiny, grad_views=4)
    for step in range(8):
        batch = made.exposure_batch(step, SENSOR, events=False)
        views, frames = batch["views"], batch["frames"]
        assert isinstance(views, Instants) and isinstance(frames, Pixels)
        opens, closes = frames.open.unique(), frames.close.unique()
        place = (views.time[0] - opens) / (closes - opens)
        assert (4 * place + 1e-3).floor().tolist() == [0, 1, 2, 3]


def test_every_frame_is_sampled_once_before_any_twice(tiny: Capture):
    made, train = sampler(tiny), tiny.split.train.tolist()
    for epoch in (0, 3):
        steps = range(epoch * len(train), (epoch + 1) * len(train))
        seen = [
            int(made.exposure_batch(s, SENSOR, events=False)["frames"].frame.unique())
            for s in steps
        ]
        assert sorted(seen) == train


def test_frames_are_as_stored(tiny: Capture):
    made, frames = (
        sampler(tiny, blur="none", event_weight=0.0, latent_weight=0.0),
        tiny.needed_frames,
    )
    for step in range(4):
        batch = made.exposure_batch(step, SENSOR, events=True)
        views, seen = batch["views"], batch["frames"]
        assert set(batch) == {"views", "frames"} and isinstance(seen, Pixels)
        frame = int(seen.frame[0, 0, 0])
        stored = torch.from_numpy(frames.images[frame] / np.float32(255))
        torch.testing.assert_close(seen.value, stored[None])
        assert (seen.track == int(frames.track[frame])).all()
        assert isinstance(views, Instants) and views.shape == (1, 1)
        middle = tiny.clock.unit(int(frames.exposure.middle_us[frame]))
        assert views.time.item() == pytest.approx(float(middle), abs=1e-6)


def test_views_that_are_only_drawn_fill_the_exposure(tiny: Capture):
    """Together with those that teach, each has a share of it of its own, and they count alike."""
    made, taken = sampler(tiny, grad_views=2, views=6), set()
    for step in range(12):
        batch = made.exposure_batch(step, SENSOR, events=False)
        views, rest, frames = batch["views"], batch["no_grad_views"], batch["frames"]
        assert isinstance(views, Instants) and isinstance(rest, Instants)
        assert isinstance(frames, Pixels)
        opens, closes = frames.open.unique(), frames.close.unique()
        learned, drawn = (
            (6 * (seen.time[0] - opens) / (closes - opens) + 1e-3).floor().int().tolist()
            for seen in (views, rest)
        )
        assert sorted(learned + drawn) == list(range(6))
        assert learned[0] < 3 <= learned[1]
        taken.update(learned)
        assert views.weight.tolist() == [[0.5] * 2]
        assert rest.weight.numpy() == pytest.approx(np.full((1, 4), 1 / 6))
    assert taken == set(range(6)), "each teaches at some time"


def phase(capture: Capture, x: int, y: int, t_us: int) -> float | None:
    """The part of an event that a pixel saw since its last one; None where nobody knows."""
    whole = capture.needed_events
    here = (whole.x == x) & (whole.y == y)
    before, after = (
        np.flatnonzero(here & (whole.t_us <= t_us)),
        np.flatnonzero(here & (whole.t_us > t_us)),
    )
    if not len(before) or not len(after):
        return None
    last, following = before[-1], after[0]
    gap = whole.t_us[following] - whole.t_us[last]
    if whole.p[last] != whole.p[following] or gap > LONGEST_US:
        return None
    return float(whole.p[last] * (t_us - whole.t_us[last]) / gap)


def test_windows_hold_the_events_of_each_pixel_and_the_parts_at_both_ends():
    capture, known = busy(), 0
    made, whole = sampler(capture), capture.needed_events
    index = event_index(whole)
    for batch in (made.exposure_batch(3, SENSOR, events=True), made.event_batch(5)):
        views, events = of(batch)
        assert events is not None and events.shape == (1, views.shape[1] - 1, 12, 16, 1)
        t_us = capture.clock.us(views.time[0].double().numpy())
        for w, (start, end) in enumerate(zip(t_us[:-1], t_us[1:], strict=True)):
            for x, y in ((7, 4), (3, 9), (12, 2), (9, 6)):
                pixel = events[0, w, y, x, 0]
                here = (whole.x == x) & (whole.y == y)
                p = whole.p[here & (whole.t_us > start) & (whole.t_us <= end)]
                ends = [phase(capture, x, y, int(t)) for t in (start, end)]
                known += sum(part is not None for part in ends)
                likely = [
                    float(phase_at(index, int(t), width=16, height=12)[0][y, x])
                    for t in (start, end)
                ]
                parts = [
                    guess if part is None else part
                    for part, guess in zip(ends, likely, strict=True)
                ]
                brighter = (p > 0).sum() + max(parts[1], 0) - max(parts[0], 0)
                darker = -(p < 0).sum() + min(parts[1], 0) - min(parts[0], 0)
                assert pixel.positive.item() == pytest.approx(brighter, abs=1e-3)
                assert pixel.negative.item() == pytest.approx(darker, abs=1e-3)
                assert pixel.slack == 0.5 * ends.count(None)
                assert pixel.xy.tolist() == [x + 0.5, y + 0.5]
    assert known > 5


def test_windows_follow_each_other_from_instant_to_instant(tiny: Capture):
    views, events = of(sampler(tiny, grad_views=4).exposure_batch(2, SENSOR, events=True))
    assert events is not None
    assert torch.equal(events.start[0, :, 0, 0, 0], views.time[0, :-1])
    assert torch.equal(events.end[0, :, 0, 0, 0], views.time[0, 1:])


def test_batches_of_events_lie_within_the_events_and_are_of_all_lengths(tiny: Capture):
    made = sampler(tiny, min_window_us=1_000, max_window_us=30_000)
    t_us = tiny.needed_events.t_us
    begin, end = (float(tiny.clock.unit(int(t))) for t in (t_us[0], t_us[-1]))
    lengths = []
    for step in range(30):
        views, _ = of(made.event_batch(step))
        assert not views.weight.any()
        assert views.time.min() >= begin - 1e-6 and views.time.max() <= end + 1e-6
        lengths.append(float(views.time[0, -1] - views.time[0, 0]) * tiny.clock.span_us)
    assert 900 < min(lengths) < 8_000 and 22_000 < max(lengths) < 30_100


def test_single_instants_come_from_the_whole_capture(tiny: Capture):
    made = sampler(tiny)
    exposure, train = tiny.needed_frames.exposure, tiny.split.train
    opens = tiny.clock.unit(int(exposure.open_us[train].min()))
    closes = tiny.clock.unit(int(exposure.close_us[train].max()))
    times = []
    for step in range(20):
        batch = made.latent_frame_batch(step, SENSOR)
        views, sharp = batch["views"], batch["latent_frames"]
        assert isinstance(views, Instants) and isinstance(sharp, Pixels)
        assert sharp.shape == (1, 16, 16, 1) and views.weight.tolist() == [[1.0]]
        assert sharp.open.unique() == views.time
        wanted = made.latent[0].at(int(tiny.clock.us(views.time.double().numpy())[0, 0]), SENSOR)
        torch.testing.assert_close(sharp.value[0, :, :, 0], wanted, atol=2e-3, rtol=0)
        times.append(float(views.time))
    assert opens <= min(times) and max(times) <= closes and max(times) - min(times) > 0.6


@pytest.mark.parametrize("part", [5, 16, 99])
def test_a_crop_cuts_everything_alike(tiny: Capture, part: int):
    side = min(part, 16)
    alone, cut = sampler(tiny, crop=part, latent_weight=0.0), sampler(tiny, crop=part)
    corners = set()
    for step in range(12):
        for name, made in (("frames", alone), ("latent_frames", cut), ("events", cut)):
            found = made.exposure_batch(step, SENSOR, events=True)
            views, seen = found["views"], found[name]
            assert isinstance(views, Instants) and views.size == (side, side)
            left, top = views.corner[0, 0].tolist()
            corners.add((left, top))
            xy = {
                "frames": seen.xy[0],
                "latent_frames": seen.xy[0, :, :, 1],
                "events": seen.xy[0, 1, ..., 0, :],
            }[name]
            assert xy.shape[:2] == (side, side)
            assert xy[0, 0].tolist() == [left + 0.5, top + 0.5]
            assert xy[-1, -1].tolist() == [left + side - 0.5, top + side - 0.5]
            if name == "frames":
                full = tiny.needed_frames.images[int(seen.frame[0, 0, 0])] / np.float32(255)
                wanted = torch.from_numpy(full[top : top + side, left : left + side])
                torch.testing.assert_close(seen.value[0], wanted)
    assert len(corners) > 5 if side < 16 else corners == {(0, 0)}
    if side == 16:
        whole = sampler(tiny).exposure_batch(3, SENSOR, events=True)
        assert same(whole, cut.exposure_batch(3, SENSOR, events=True))


def test_a_batch_depends_on_seed_and_step_alone(tiny: Capture):
    def drawn(made: ViewSampler, step: int) -> list[Batch]:
        return [
            made.latent_frame_batch(step, SENSOR),
            made.exposure_batch(step, SENSOR, events=True),
            made.event_batch(step),
        ]

    first, again, other = sampler(tiny, 7), sampler(tiny, 7), sampler(tiny, 8)
    drawn(again, 1)  # what was sampled before does not matter
    for one, two, three, later in zip(
        drawn(first, 5), drawn(again, 5), drawn(other, 5), drawn(first, 6), strict=True
    ):
        assert same(one, two) and not same(one, three) and not same(one, later)


def test_behind_a_colour_filter_every_pixel_has_three_measurements():
    made = sampler(coloured(), grad_views=2)
    _, events = of(made.exposure_batch(1, SENSOR, events=True))
    assert events is not None and events.shape == (1, 2, 12, 16, 3)
    assert events.channel is not None and events.channel[0, 1, 5, 6].tolist() == [0, 1, 2]
    moved = events.positive - events.negative
    seen = [float(moved[..., colour].sum()) for colour in range(3)]
    assert len(set(seen)) == 3, "each colour has events of its own"
    sharp = made.latent_frame_batch(0, SENSOR)["latent_frames"]
    assert isinstance(sharp, Pixels) and sharp.value.shape == (1, 12, 16, 1, 3)


def test_latent_frames_follow_the_sensor_estimate(tiny: Capture):
    made = sampler(tiny)
    usual, *others = (
        made.latent_frame_batch(4, sensor_estimate)["latent_frames"]
        for sensor_estimate in (
            SENSOR,
            SensorEstimate(0.2, 0.2, 5_000),
            SensorEstimate(0.3, 0.3),
            SENSOR,
        )
    )
    assert [torch.equal(usual.value, other.value) for other in others] == [False, False, True]
    assert all(torch.equal(usual.open, other.open) for other in others)


def test_photos_of_unknown_motion_have_no_latent_frames(tiny: Capture):
    unknown = replace(tiny, known=replace(tiny.known, motion="unknown"))
    assert sampler(tiny).latent and not sampler(unknown).latent


def test_a_frame_of_no_length_is_one_view(tiny: Capture):
    sharp = replace(tiny, split=replace(tiny.split, train=tiny.split.test, test=tiny.split.train))
    batch = sampler(sharp, grad_views=5, event_weight=0.0, latent_weight=0.0).exposure_batch(
        0, SENSOR, events=False
    )
    assert batch["views"].shape == (1, 1)


def test_what_cannot_be_learned_from_is_refused(tiny: Capture):
    with pytest.raises(CaptureError, match="learns from frames"):
        sampler(tiny.without(frames=True), event_weight=0.0)
    held_out = replace(tiny, split=replace(tiny.split, train=tiny.split.train[:0]))
    with pytest.raises(CaptureError, match="no frame is left to learn from"):
        sampler(held_out)
