"""Between two events of one sign the light is where the share of time says."""

import numpy as np
import pytest
import torch

from sharpfield.core.events import EventStream
from sharpfield.events.counts import EventMotion, counts_between
from sharpfield.events.index import build_index
from sharpfield.events.ramps import FALL_US, LONGEST_US, OVERSHOOT, phase_at
from sharpfield.simulation.cameras.motions import motion
from sharpfield.simulation.scenes.static import scene
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate, view
from sharpfield.storage.event_cache import event_index

SIZE = {"width": 3, "height": 1}


def stream(*events: tuple[int, int, int]) -> EventStream:
    """Events (x, time in us, polarity) of a sensor of three pixels."""
    x, t_us, p = np.array(sorted(events, key=lambda event: event[1])).T
    zeros = np.zeros(len(x), np.int16)
    return EventStream(
        x.astype(np.int16), zeros, t_us.astype(np.int64), p.astype(np.int8), width=3, height=1
    )


@pytest.mark.parametrize("polarity", [-1, 1])
def test_half_way_in_time_is_half_an_event(polarity: int) -> None:
    index = build_index(stream((1, 1000, polarity), (1, 5000, polarity)))
    for time_us, share in ((1000, 0.0), (2000, 0.25), (3000, 0.5), (4999, 0.99975)):
        phase, known = phase_at(index, time_us, **SIZE)
        assert known.tolist() == [[False, True, False]]
        torch.testing.assert_close(phase, torch.tensor([[0.0, polarity * share, 0.0]]))


@pytest.mark.parametrize(
    ("events", "likely"),
    [
        ([(0, 1000, 1), (0, 9000, -1)], OVERSHOOT),
        ([(0, 1000, -1), (0, 9000, 1)], -OVERSHOOT),
        ([(0, 3000, 1)], 0),
        ([(0, 1000, -1)], -OVERSHOOT),
        ([(0, 1000, 1), (0, 1001 + LONGEST_US, 1)], OVERSHOOT / 2),
    ],
    ids=["turned down", "turned up", "nothing before", "nothing after", "too far apart"],
)
def test_elsewhere_it_is_unknown_but_likely(
    events: list[tuple[int, int, int]], likely: float
) -> None:
    phase, known = phase_at(build_index(stream(*events)), 2000, **SIZE)
    assert not known.any()
    torch.testing.assert_close(phase, torch.tensor([[likely, 0.0, 0.0]]).float())


def test_light_that_turned_falls_to_the_next_event_at_last() -> None:
    """Without a jump, within `FALL_US` before it, and by then all the way."""
    index = build_index(stream((1, 1000, 1), (1, 31_000, -1)))
    phase = [float(phase_at(index, 31_000 - ahead, **SIZE)[0][0, 1]) for ahead in range(6000)]
    assert phase[FALL_US:] == [pytest.approx(OVERSHOOT)] * (6000 - FALL_US)
    assert phase[1] == pytest.approx(-1, abs=1e-3)
    steps = np.diff(phase[1 : FALL_US + 1])
    assert steps == pytest.approx((1 + OVERSHOOT) / FALL_US, abs=1e-6)


def test_a_thrown_stone_is_a_third_of_a_threshold_up_on_average() -> None:
    """The mean over all tops between two thresholds, and over the time until it is back."""
    top, part = np.random.default_rng(0).random((2, 100_000))
    assert np.mean(4 * top * part * (1 - part)) == pytest.approx(OVERSHOOT, abs=0.01)


def test_events_at_one_time_are_no_trouble() -> None:
    phase, _ = phase_at(
        build_index(stream((0, 1000, 1), (0, 2000, 1), (0, 2000, -1))), 2000, **SIZE
    )
    assert phase[0, 0] == pytest.approx(-OVERSHOOT)


def test_at_an_event_whole_counts_meet() -> None:
    """Just before an event the phase is nearly one; just after it the count is one higher."""
    index = build_index(stream((0, 1000, 1), (0, 5000, 1), (0, 9000, 1)))
    before, after = (float(phase_at(index, t, **SIZE)[0][0, 0]) for t in (4999, 5000))
    assert before == pytest.approx(1, abs=1e-3) and after == 0


def simulated(threshold: float, size: tuple[int, int], times: list[int]):
    """For each two times that follow: change of light, whole counts, with phases, where known."""
    timing = Timing(frames=3, exposure_us=0, interval_us=40_000, step_us=250, test_every=0)
    sensor = EventSensor(threshold_on=threshold, threshold_off=threshold)
    capture = simulate("tiles", "shaky", rig=Rig(size, event_sensor=sensor), timing=timing, seed=2)
    moving, index = EventMotion.of(capture), event_index(capture.needed_events)
    place, path = scene("tiles"), motion("shaky", 2)

    def log_light(t_us: int) -> torch.Tensor:
        pose = path.poses(np.array([t_us]))[0]
        rgb = torch.from_numpy(view(place, capture.camera, pose, 1e-6 * t_us)[0])
        return (rgb @ torch.tensor([0.299, 0.587, 0.114]) + 1e-5).log()

    rows = []
    for start, end in zip(times[:-1], times[1:], strict=True):
        count = torch.cat(counts_between(moving, start, end), -1).sum(-1)
        (first, begin), (last, finish) = (
            phase_at(index, t, width=size[0], height=size[1]) for t in (start, end)
        )
        light = log_light(end) - log_light(start)
        rows.append((light, count, count + last - first, begin & finish & (count != 0)))
    return [torch.stack(values) for values in zip(*rows, strict=True)]


def slope(light: torch.Tensor, told: torch.Tensor) -> float:
    """The threshold that explains the light best."""
    return float((light * told).sum() / told.square().sum())


def test_with_the_phase_counts_tell_the_change_of_light() -> None:
    """Against the simulator's own light: unbiased, and much closer than whole counts."""
    threshold = 0.1
    *all_of_them, known = simulated(threshold, (36, 24), list(range(12_000, 88_000, 15_000)))
    light, rough, fine = (values[known] for values in all_of_them)
    assert len(light) > 100
    assert slope(light, fine) == pytest.approx(threshold, rel=0.02)
    assert (light - threshold * fine).std() < 0.4 * (light - threshold * rough).std()


def test_with_the_overshoot_they_do_at_every_pixel() -> None:
    """Known or not: what counts alone leave out goes the way that they went."""
    threshold = 0.2
    light, rough, fine, _ = simulated(threshold, (90, 60), [25_000, 55_000, 85_000])
    assert slope(light, rough) > 1.04 * threshold
    assert slope(light, fine) == pytest.approx(threshold, rel=0.03)
    assert (light - threshold * fine).std() < 0.9 * (light - threshold * rough).std()
