import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.core.events import checked
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.events import EventPixels, Gap, joined, watch

MS = 1_000_000


def run(sensor: EventSensor, times_ns: list[int], logs: np.ndarray, seed: int = 0):
    """Events of pixels whose log intensity goes straight between `logs` [n h w]."""
    pixels = EventPixels(sensor, seed)
    light = np.exp(logs) - sensor.floor
    gaps = [pixels.see(a, t) for a, t in zip(light.astype(np.float32), times_ns, strict=True)]
    return joined(gaps, (logs.shape[2], logs.shape[1]))


def walk(pixels: int, steps: int, seed: int = 0, size: float = 0.35) -> np.ndarray:
    """Log intensities that wander, [steps 1 pixels]."""
    draw = np.random.default_rng(seed)
    path = np.cumsum(draw.normal(0, size, (steps, 1, pixels)), 0)
    return np.clip(-1.5 + path, -3.5, 0)


def test_constant_light_gives_no_events():
    logs = np.tile(walk(50, 1), (20, 1, 1))
    assert len(run(EventSensor(), list(range(0, 20 * MS, MS)), logs)) == 0


def test_a_ramp_crosses_when_it_should():
    """log I from -3 to -1 in 20 ms, thresholds 0.3 and 0.25: one event each 3 ms, or 2.5 ms."""
    sensor = EventSensor(threshold_on=0.3, threshold_off=0.25)
    logs = np.array([[[-3.0, -1.0]], [[-1.0, -3.0]]])
    events = run(sensor, [0, 20 * MS], logs)
    up, down = events.t_us[events.x == 0], events.t_us[events.x == 1]
    np.testing.assert_array_equal(up, [3000, 6000, 9000, 12000, 15000, 18000])
    np.testing.assert_array_equal(down, np.arange(1, 8) * 2500)
    assert set(events.p[events.x == 0]) == {1} and set(events.p[events.x == 1]) == {-1}


def test_a_moving_edge_fires_one_pixel_after_the_other():
    speed, sensor = 500.0, EventSensor(threshold_on=0.2)  # px per s: 2 ms from pixel to pixel
    x, times = np.arange(12), np.arange(0, 40 * MS, MS // 4)
    reach = (speed * times[:, None] * 1e-9 - x) / 3.0  # a straight flank 3 px wide
    logs = -2.0 + np.clip(reach, 0, 1)[:, None, :]
    events = run(sensor, times.tolist(), logs)
    first = [events.t_us[events.x == i] for i in x]
    assert {len(t) for t in first} == {4}  # four times 0.2 below 1, the fifth at 1 itself, or not
    for earlier, later in zip(first, first[1:], strict=False):
        np.testing.assert_allclose(later - earlier, 2000, atol=1)
    np.testing.assert_allclose(first[0], 1e6 / speed * 3 * 0.2 * np.arange(1, 5), atol=1)


def test_darker_is_brighter_upside_down():
    logs = walk(200, 30)
    times = list(range(0, 30 * MS, MS))
    sensor = EventSensor(threshold_on=0.17, threshold_off=0.17)
    a, b = run(sensor, times, logs), run(sensor, times, -4.0 - logs)
    a, b = (np.lexsort((e.t_us, e.x)) for e in (a, b)), (a, b)
    (i, j), (a, b) = a, b
    np.testing.assert_array_equal(a.x[i], b.x[j])
    np.testing.assert_allclose(a.t_us[i], b.t_us[j], atol=1)  # logs of float32 light
    np.testing.assert_array_equal(a.p[i], -b.p[j])


def test_counts_add_up_to_the_change_of_light():
    logs, sensor = walk(300, 40), EventSensor(threshold_on=0.21, threshold_off=0.16)
    events = run(sensor, list(range(0, 40 * MS, MS)), logs)
    steps = np.where(events.p > 0, 0.21, -0.16)
    told = np.bincount(events.x, steps, minlength=300)
    rest = (logs[-1] - logs[0])[0] - told
    assert rest.max() < 0.21 + 1e-5 and rest.min() > -0.16 - 1e-5


def test_cutting_a_straight_piece_changes_nothing():
    logs = walk(100, 12)
    fine = np.empty((23, 1, 100))
    fine[::2], fine[1::2] = logs, 0.5 * (logs[:-1] + logs[1:])
    sensor = EventSensor(refractory_us=700.0, refractory_rule="reset", leak_hz=8.0)
    coarse = run(sensor, [k * 2 * MS for k in range(12)], logs)
    cut = run(sensor, [k * MS for k in range(23)], fine)
    assert len(coarse) == len(cut) > 100
    i, j = np.lexsort((coarse.t_us, coarse.x)), np.lexsort((cut.t_us, cut.x))
    np.testing.assert_array_equal(coarse.x[i], cut.x[j])
    np.testing.assert_allclose(coarse.t_us[i], cut.t_us[j], atol=1)


def test_the_stream_is_sound_and_sorted_even_over_long_gaps():
    logs = walk(40, 6)
    for gap_ns in (MS, 3_000_000_000):  # counted, and beyond the length of the table
        events = checked(run(EventSensor(), [k * gap_ns for k in range(6)], logs), "test")
        assert len(events) > 100
        assert (events.x.dtype, events.t_us.dtype, events.p.dtype) == (np.int16, np.int64, np.int8)
        times = np.stack([events.t_us, events.x])
        later = np.lexsort((times[1], times[0]))  # equal times in the order of pixels
        np.testing.assert_array_equal(later, np.arange(len(events)))


def dense(sensor: EventSensor, times_ns: list[int], logs: np.ndarray):
    """The same pixels, looked at every us: obvious, and slow."""
    level = logs.reshape(len(logs), -1)
    n = level.shape[1]
    reference, ready, waiting = level[0].copy(), np.full(n, -1), np.zeros(n, bool)
    found = []
    for t_us in range(1, times_ns[-1] // 1000 + 1):
        leaked = sensor.leak_hz * sensor.threshold_on * 1e-6 * t_us
        k = min(np.searchsorted(times_ns, 1000 * t_us) - 1, len(level) - 2)
        share = (1000 * t_us - times_ns[k]) / (times_ns[k + 1] - times_ns[k])
        now = level[k] * (1 - share) + level[k + 1] * share + leaked
        again = waiting & (t_us >= ready)
        reference[again], waiting[again] = now[again], False
        for p, threshold in ((1, sensor.threshold_on), (-1, sensor.threshold_off)):
            fired = (p * (now - reference) >= threshold) & ~waiting
            reference[fired] += p * threshold
            shown = fired & (t_us >= ready)
            found += [(int(x), t_us, p) for x in np.flatnonzero(shown)]
            if sensor.refractory_us:
                ready[shown] = t_us + sensor.refractory_us
                waiting[shown] = sensor.refractory_rule == "reset"
    return np.array(sorted(found)).T


@pytest.mark.parametrize(
    "sensor",
    [
        EventSensor(threshold_on=0.18, threshold_off=0.23),
        EventSensor(refractory_us=900.0, refractory_rule="drop"),
        EventSensor(refractory_us=900.0, refractory_rule="reset"),
        EventSensor(refractory_us=2500.0, refractory_rule="reset", leak_hz=30.0),
        EventSensor(threshold_off=0.3, refractory_us=2500.0, refractory_rule="drop", leak_hz=50.0),
    ],
    ids=["ideal", "drop", "reset", "reset, long, leaking", "drop, long, leaking"],
)
def test_against_a_slow_loop(sensor):
    logs, times = walk(40, 9, seed=7), [k * MS for k in range(9)]
    events = run(sensor, times, logs)
    order = np.lexsort((events.p, events.t_us, events.x))
    x, t_us, p = dense(sensor, times, logs)
    assert len(x) > 60
    np.testing.assert_array_equal(events.x[order], x)
    np.testing.assert_array_equal(events.p[order], p)
    # Resetting a us late moves the reference, and the next crossing by more where light is slow.
    np.testing.assert_allclose(events.t_us[order], t_us, atol=30)


def test_dead_time_separates_events_of_a_pixel():
    logs, times = walk(100, 20, size=1.0), [k * MS for k in range(20)]
    for rule in ("drop", "reset"):
        events = run(EventSensor(refractory_us=300.0, refractory_rule=rule), times, logs)
        gaps = np.concatenate([np.diff(events.t_us[events.x == x]) for x in range(100)])
        assert len(gaps) > 200 and 299 <= gaps.min() < 500  # both ends are rounded


def test_same_seed_same_events_other_seed_others():
    sensor = EventSensor(threshold_sigma=0.03, shot_hz=50.0, leak_hz=5.0, leak_jitter=0.5)
    logs, times = walk(64, 10), [k * MS for k in range(10)]
    a, b, c = (run(sensor, times, logs, seed) for seed in (3, 3, 4))
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert len(a) != len(c) or (a.t_us != c.t_us).any()


def still(sensor: EventSensor, light: float, seconds: float = 10.0, n: int = 400):
    frames = np.full((int(seconds * 20) + 1, 1, n), np.log(light + sensor.floor))
    return run(sensor, [k * 50 * MS for k in range(len(frames))], frames)


def test_leak_fires_on_at_its_rate_and_jitter():
    even = still(EventSensor(leak_hz=2.0), 0.5, n=5)
    assert set(even.p) == {1}
    np.testing.assert_allclose(even.t_us[even.x == 3], np.arange(1, 21) * 500_000, atol=2)
    unsteady = still(EventSensor(leak_hz=2.0, leak_jitter=0.3), 0.5)
    assert abs(len(unsteady) / (400 * 10) - 2.0) < 0.1
    gaps = np.concatenate([np.diff(unsteady.t_us[unsteady.x == x]) for x in range(400)])
    assert abs(gaps.std() / gaps.mean() - 0.3) < 0.03


@pytest.mark.parametrize(("light", "rate"), [(0.0, 3.0), (1.0, 0.75), (0.5, 1.875)])
def test_shot_noise_is_poisson_and_falls_with_light(light, rate):
    events = still(EventSensor(shot_hz=3.0), light)
    counts = np.bincount(events.x, minlength=400)
    expected = 10 * rate
    assert abs(counts.mean() - expected) < 4 * np.sqrt(expected / 400)
    assert abs(counts.var() / expected - 1) < 0.3  # as for every Poisson process
    assert abs(events.p.mean()) < 4 / np.sqrt(len(events))
    # Events do not prefer the ends of gaps.
    assert abs((events.t_us % 50_000).mean() / 50_000 - 0.5) < 0.02


def test_hot_pixels_fire_without_reason():
    events = still(EventSensor(hot_share=0.05, hot_hz=50.0), 0.5, seconds=2)
    hot, counts = np.unique(events.x, return_counts=True)
    assert 8 <= len(hot) <= 35
    assert (np.abs(counts - 100) <= 1).all()


def test_thresholds_are_fixed_for_each_pixel_and_spread():
    sensor = EventSensor(threshold_on=0.3, threshold_off=0.2, threshold_sigma=0.03)
    pixels = EventPixels(sensor, 0)
    pixels.see(np.full((60, 60), 0.1, np.float32), 0)
    on, off = pixels.thresholds()
    for got, mean in ((on, 0.3), (off, 0.2)):
        assert abs(got.mean() - mean) < 0.003 and abs(got.std() - 0.03) < 0.003
    events = pixels.see(np.full((60, 60), 0.1 * np.exp(0.99), np.float32), MS)
    counts = np.zeros((60, 60), int)
    np.add.at(counts, (events.y, events.x), 1)
    clear = np.abs(0.99 / on - np.rint(0.99 / on)) > 1e-3
    np.testing.assert_array_equal(counts[clear], np.floor(0.99 / on)[clear])


def test_a_random_start_is_between_the_thresholds():
    """A ramp of half a threshold then makes half of the pixels fire."""
    logs = np.stack([np.full((1, 4000), -2.0), np.full((1, 4000), -1.9)])
    events = run(EventSensor(start="random", threshold_off=0.2), [0, MS], logs)
    assert abs(len(events) / 4000 - 0.25) < 0.03  # 0.1 of the dead zone of 0.4


def test_a_slow_pixel_follows_a_step_exponentially():
    sensor = EventSensor(threshold_on=0.1, cutoff_hz=100.0)
    times = [0, 1] + [k * MS // 10 for k in range(1, 200)]  # a step within the first ns
    logs = np.full((len(times), 1, 1), 0.0)
    logs[0] = -1.0
    events = run(sensor, times, logs)
    tau_us = 1e6 / (2 * np.pi * 100)
    expected = -tau_us * np.log(1 - 0.1 * np.arange(1, 10))
    np.testing.assert_allclose(events.t_us[:9], expected, rtol=0.01, atol=2)


def test_darkness_is_slower():
    sensor = EventSensor(threshold_on=0.1, cutoff_hz=100.0)
    times, step = [k * MS // 10 for k in range(100)], np.zeros((100, 1, 2))
    step[:, :, 1] = -3.0
    step[0] -= 0.5
    events = run(sensor, times, step)
    assert events.t_us[events.x == 1][0] > 3 * events.t_us[events.x == 0][0]


def test_a_bayer_pixel_sees_its_own_channel():
    rgb = np.full((4, 4, 3), 0.1, np.float32)
    pixels = EventPixels(EventSensor(bayer="RGGB"), 0)
    pixels.see(rgb, 0)
    for channel, sites in ((0, {(0, 0)}), (1, {(0, 1), (1, 0)}), (2, {(1, 1)})):
        rgb = rgb.copy()
        rgb[..., channel] *= np.float32(np.exp(0.25))
        events = pixels.see(rgb, (channel + 1) * MS)
        assert set(zip((events.y % 2).tolist(), (events.x % 2).tolist(), strict=True)) == sites
        assert len(events.x) == 4 * len(sites)


def test_a_grey_pixel_sees_luma():
    pixels = EventPixels(EventSensor(floor=0.0, threshold_on=0.1), 0)
    pixels.see(np.array([[[0.2, 0.4, 0.6]]], np.float32), 0)
    before, after = 0.299 * 0.2 + 0.587 * 0.4 + 0.114 * 0.6, 0.587 * 0.6 + 0.299 * 0.2 + 0.0684
    events = pixels.see(np.array([[[0.2, 0.6, 0.6]]], np.float32), MS)
    expected = 1000 * 0.1 * np.arange(1, 3) / np.log(after / before)
    np.testing.assert_allclose(events.t_us, expected, atol=1)


def test_lin_log_is_the_logarithm_in_light_and_straight_in_the_dark():
    pixels = EventPixels(EventSensor(curve="lin-log", floor=0.0, threshold_on=0.1), 0)
    pixels.see(np.array([[0.02, 0.2]], np.float32), 0)
    events = pixels.see(np.array([[0.05, 0.5]], np.float32), MS)
    dark, light = (int((events.x == x).sum()) for x in (0, 1))
    assert dark == int(0.03 / (20 / 255) / 0.1) and light == int(np.log(2.5) / 0.1)


def test_watching_bounds_the_change_between_images():
    def render(t_us: int) -> np.ndarray:
        value = 0.5 + 0.4 * np.sin(2 * np.pi * t_us / 40_000 + np.arange(6.0))
        return np.tile(value[None, :, None], (2, 1, 3)).astype(np.float32)

    instants = np.arange(0, 80_001, 10_000)
    seen = list(watch(render, instants, most_change=0.15, shortest_us=100))
    times = np.array([t for t, _ in seen])
    assert set(instants) <= set(times) and (np.diff(times) > 0).all()
    logs = np.log(np.stack([rgb for _, rgb in seen]))
    assert np.abs(np.diff(logs, axis=0)).max() <= 0.15
    assert len(times) < 400  # and is fine only where it must be: even steps would need 400
    for t_us, rgb in seen[::7]:
        np.testing.assert_array_equal(rgb, render(t_us))


def test_one_image_and_one_pixel():
    pixels = EventPixels(EventSensor(), 0)
    first = pixels.see(np.full((1, 1), 0.5, np.float32), 7)
    assert isinstance(first, Gap) and len(first.x) == 0
    second = pixels.see(np.full((1, 1), 0.9, np.float32), 1000 * 1000)
    assert list(second.p) == [1, 1] and list(second.x) == [0, 0]


def test_time_must_run_forward():
    pixels = EventPixels(EventSensor(), 0)
    pixels.see(np.full((1, 1), 0.5, np.float32), 2000)
    with pytest.raises(OptionError, match="order of time\n  got    2000 ns, 2000 ns"):
        pixels.see(np.full((1, 1), 0.5, np.float32), 2000)


def test_a_sensor_says_what_is_wrong_with_it():
    with pytest.raises(OptionError, match="thresholds must be positive\n  got    on 0.0"):
        EventSensor(threshold_on=0.0)
    with pytest.raises(OptionError, match="colour filter tile\n  got    RGB"):
        EventSensor(bayer="RGB")
