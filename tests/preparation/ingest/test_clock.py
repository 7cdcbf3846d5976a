import cv2
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import Exposure
from sharpfield.preparation.ingest.clock import (
    exposures_from_triggers,
    find_offset,
    shifted,
    with_exposure,
)
from sharpfield.recordings.recording import Triggers
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.events import EventPixels, joined

SECONDS, FRAMES, INTERVAL_US = 6, 150, 33_333


def activity(seed: int, *, steady: bool = False) -> np.ndarray:
    """Events in each ms of a camera that is moved by hand, now faster and now slower."""
    draw = np.random.default_rng(seed)
    if steady:
        return draw.poisson(300, 1000 * SECONDS)
    rough = np.repeat(draw.gamma(2.0, 1.0, 10 * SECONDS), 100)
    smooth = np.convolve(rough, np.hanning(150) / np.hanning(150).sum(), "same")
    return draw.poisson(300 * smooth)


def seen(events_per_ms: np.ndarray, lag_us: int, *, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Middles of exposures on a clock that is late by a lag, and how much images changed."""
    true_us = 300_000 + np.arange(FRAMES, dtype=np.int64) * INTERVAL_US
    until = np.concatenate([[0], np.cumsum(events_per_ms)])
    change = np.diff(np.interp(true_us / 1000, np.arange(len(until)), until))
    change = change * (1 + noise * np.random.default_rng(1).standard_normal(len(change)))
    return true_us + lag_us, change


@pytest.mark.parametrize("lag_us", [0, 12_345, -250_000, 900_000_000_000])
@pytest.mark.parametrize("origin_us", [0, 1_600_000_000_000_000])
def test_the_offset_is_found(lag_us, origin_us):
    events_per_ms = activity(0)
    middles_us, change = seen(events_per_ms, lag_us, noise=0.2)
    found = find_offset(change, middles_us + origin_us, events_per_ms, origin_us)
    assert found.certain, str(found)
    assert abs(found.offset_us + lag_us) <= max(found.uncertainty_us, 2000)
    assert found.uncertainty_us <= 10_000


def shaken(seed: int, threshold: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A textured wall before a shaking camera: changes, middles of exposures, events in each ms."""
    draw, gaps, shown = np.random.default_rng(seed), [], []
    rough = draw.standard_normal((96, 96)).astype(np.float32)
    wall = cv2.GaussianBlur(rough, (0, 0), 1.5) + 2 * cv2.GaussianBlur(rough, (0, 0), 4)
    wall = 0.2 * np.exp(0.6 * wall / wall.std())
    hz, phase = draw.uniform(0.7, 6, 8), draw.uniform(0, 2 * np.pi, (2, 8))
    times_us = np.arange(0, 40 * INTERVAL_US + 30_000, 2000)
    pixels = EventPixels(EventSensor(threshold_on=threshold, threshold_off=threshold), seed)
    for t_us in times_us:
        x, y = (5 / hz**0.9 * np.sin(2e-6 * np.pi * hz * t_us + phase)).sum(-1)
        moved = np.array([[1, 0, 24 + x], [0, 1, 32 + y]], np.float32)
        seen = cv2.warpAffine(wall, moved, (48, 32), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR)
        shown.append(np.clip(seen, 0, 1))
        gaps.append(pixels.see(shown[-1], 1000 * int(t_us)))
    opens_us = 10_000 + 2000 * (np.arange(40, dtype=np.int64) * INTERVAL_US // 2000)
    light = [np.mean(shown[i : i + 6], 0) for i in opens_us // 2000]
    change = np.abs(np.diff(np.log(np.maximum(light, 1 / 255)), axis=0)).mean(
        (1, 2), dtype=np.float64
    )
    return change, opens_us + 5000, np.bincount(joined(gaps, (48, 32)).t_us // 1000)


def test_the_search_itself_is_not_late_but_events_of_high_thresholds_are():
    off_us = []
    for seed in (0, 1, 3):
        (change, middles_us, fine), (_, _, coarse) = (shaken(seed, c) for c in (0.05, 0.4))
        same, late = (find_offset(change, middles_us, events, 0) for events in (fine, coarse))
        planted = find_offset(change, middles_us - 50_000, fine, 0)
        assert abs(same.offset_us) <= 2000 and abs(planted.offset_us - 50_000) <= 2000
        off_us.append((same.offset_us, late.offset_us))
    fine_us, coarse_us = np.mean(off_us, 0)
    assert abs(fine_us) < 1000 and 1000 < coarse_us < 8000


def test_the_best_offset_is_that_of_a_slow_search():
    events_per_ms = activity(2)
    middles_us, change = seen(events_per_ms, 40_000, noise=0.3)
    until = np.concatenate([[0], np.cumsum(events_per_ms)])
    ms = (middles_us - middles_us[0] + 500) // 1000
    best = max(
        range(len(events_per_ms) - int(ms[-1]) + 1),
        key=lambda o: np.corrcoef(np.diff(until[ms + o]), change)[0, 1],
    )
    found = find_offset(change, middles_us, events_per_ms, 0)
    assert abs(found.offset_us + int(middles_us[0]) - 1000 * best) <= 500


def test_steady_motion_tells_nothing():
    events_per_ms = activity(0, steady=True)
    middles_us, change = seen(events_per_ms, 0, noise=0.2)
    assert not find_offset(change, middles_us, events_per_ms, 0).certain


def test_other_motion_is_not_believed():
    middles_us, change = seen(activity(3), 0, noise=0.2)
    assert not find_offset(change, middles_us, activity(4), 0).certain


def test_too_few_frames_are_refused():
    events_per_ms = activity(0)
    middles_us, change = seen(events_per_ms, 0, noise=0.0)
    with pytest.raises(CaptureError, match="too few frames"):
        find_offset(change[:4], middles_us[:5], events_per_ms, 0)
    with pytest.raises(CaptureError, match="cannot have been recorded together"):
        find_offset(change, middles_us, events_per_ms[:50], 0)


# Exposures


def instants() -> Exposure:
    times_us = np.arange(4, dtype=np.int64) * 40_000
    return Exposure(times_us, times_us)


@pytest.mark.parametrize(
    ("length", "stamp", "first"),
    [
        ("0.5", "open", (0, 20_000)),
        ("8ms", "open", (0, 8_000)),
        ("8000us", "middle", (-4_000, 4_000)),
        ("0.04s", "close", (-40_000, 0)),
    ],
)
def test_exposures_get_their_length(length, stamp, first):
    assert with_exposure(instants(), length, stamp).window(0) == first


def test_exposures_with_a_length_keep_it():
    known = Exposure(np.array([0, 40_000]), np.array([5_000, 40_000]))
    found = with_exposure(known, "10ms", "open")
    assert [found.window(0), found.window(1)] == [(0, 5_000), (40_000, 50_000)]


@pytest.mark.parametrize("length", ["", "fast", "1.5", "-3ms", "infs"])
def test_a_length_that_cannot_be_read(length):
    with pytest.raises(OptionError, match="cannot read the exposure"):
        with_exposure(instants(), length, "open")


def test_exposures_that_would_overlap():
    with pytest.raises(OptionError, match="would overlap"):
        with_exposure(instants(), "50ms", "open")


def test_shifting_and_back():
    there = shifted(instants(), 77)
    assert there.window(1) == (40_077, 40_077)
    np.testing.assert_array_equal(shifted(there, -77).open_us, instants().open_us)


# Triggers


def pulses(count: int, channel: int = 0) -> Triggers:
    rise = np.arange(count, dtype=np.int64) * 10_000 + 500
    t_us = np.stack([rise, rise + 4_000], -1).ravel()
    edge = np.tile(np.array([1, -1], np.int8), count)
    return Triggers(t_us, edge, np.full(2 * count, channel, np.uint8))


def both(a: Triggers, b: Triggers) -> Triggers:
    return Triggers(
        np.concatenate([a.t_us, b.t_us]),
        np.concatenate([a.edge, b.edge]),
        np.concatenate([a.channel, b.channel]),
    )


def test_pulses_are_exposures():
    found = exposures_from_triggers(pulses(3), 3, channel=None, where="cam.raw")
    assert [found.window(i) for i in range(3)] == [(500, 4_500), (10_500, 14_500), (20_500, 24_500)]


def test_an_edge_before_the_first_pulse_is_no_exposure():
    late = pulses(3)
    truncated = Triggers(late.t_us[1:], late.edge[1:], late.channel[1:])
    assert exposures_from_triggers(truncated, 2, channel=None, where="cam.raw").window(0) == (
        10_500,
        14_500,
    )


def test_one_of_several_channels_has_to_be_named():
    mixed = both(pulses(3), pulses(5, channel=6))
    with pytest.raises(CaptureError, match="several channels") as caught:
        exposures_from_triggers(mixed, 3, channel=None, where="cam.raw")
    assert "0, 6" in str(caught.value)
    assert len(exposures_from_triggers(mixed, 5, channel=6, where="cam.raw")) == 5


@pytest.mark.parametrize("count", [2, 4])
def test_there_must_be_a_pulse_for_each_frame(count):
    with pytest.raises(CaptureError, match=f"3 pulses, {count} frames"):
        exposures_from_triggers(pulses(3), count, channel=None, where="cam.raw")
