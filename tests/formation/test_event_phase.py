"""Between two events of one sign the light is where the share of time says."""

import numpy as np
import pytest
import torch

from sharpfield.captures import event_index
from sharpfield.core import EventStream
from sharpfield.formation.event_counts import counts_between
from sharpfield.formation.event_motion import EventMotion
from sharpfield.formation.event_phase import LONGEST_US, phase_at
from sharpfield.ops.event_index import build
from sharpfield.simulation import EventSensor, Rig, Timing, motion, scene, simulate
from sharpfield.simulation.simulate import view

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
    index = build(stream((1, 1000, polarity), (1, 5000, polarity)))
    for time_us, share in ((1000, 0.0), (2000, 0.25), (3000, 0.5), (4999, 0.99975)):
        phase, known = phase_at(index, time_us, **SIZE)
        assert known.tolist() == [[False, True, False]]
        torch.testing.assert_close(phase, torch.tensor([[0.0, polarity * share, 0.0]]))


@pytest.mark.parametrize(
    "events",
    [
        [(0, 1000, 1), (0, 3000, -1)],
        [(0, 3000, 1)],
        [(0, 1000, 1)],
        [(0, 1000, 1), (0, 1001 + LONGEST_US, 1)],
    ],
    ids=["turned around", "nothing before", "nothing after", "too far apart"],
)
def test_elsewhere_it_is_unknown(events: list[tuple[int, int, int]]) -> None:
    phase, known = phase_at(build(stream(*events)), 2000, **SIZE)
    assert not known.any() and (phase == 0).all()


def test_at_an_event_whole_counts_meet() -> None:
    """Just before an event the phase is nearly one; just after it the count is one higher."""
    index = build(stream((0, 1000, 1), (0, 5000, 1), (0, 9000, 1)))
    before, after = (float(phase_at(index, t, **SIZE)[0][0, 0]) for t in (4999, 5000))
    assert before == pytest.approx(1, abs=1e-3) and after == 0


def test_with_the_phase_counts_tell_the_change_of_light() -> None:
    """Against the simulator's own light: unbiased, and much closer than whole counts."""
    threshold, size = 0.1, (36, 24)
    timing = Timing(frames=3, exposure_us=0, interval_us=40_000, step_us=250, test_every=0)
    sensor = EventSensor(threshold_on=threshold, threshold_off=threshold)
    capture = simulate("tiles", "shaky", rig=Rig(size, event_sensor=sensor), timing=timing, seed=2)
    moving, index = EventMotion.of(capture), event_index(capture.needed_events)
    place, path = scene("tiles"), motion("shaky", 2)
    times = list(range(12_000, 88_000, 15_000))

    def log_light(t_us: int) -> torch.Tensor:
        pose = path.poses(np.array([t_us]))[0]
        rgb = torch.from_numpy(view(place, capture.camera, pose, 1e-6 * t_us)[0])
        return (rgb @ torch.tensor([0.299, 0.587, 0.114]) + 1e-5).log()

    change, whole, parts = [], [], []
    for start, end in zip(times[:-1], times[1:], strict=True):
        negative, positive = counts_between(moving, start, end)
        (first, begin), (last, finish) = (
            phase_at(index, t, width=size[0], height=size[1]) for t in (start, end)
        )
        count = (negative + positive)[..., 0]
        used = begin & finish & (count != 0)
        change.append((log_light(end) - log_light(start))[used])
        whole.append(count[used])
        parts.append((count + last - first)[used])
    light, rough, fine = (torch.cat(values) for values in (change, whole, parts))
    assert len(light) > 100
    assert float((light * fine).sum() / fine.square().sum()) == pytest.approx(threshold, rel=0.02)
    assert (light - threshold * fine).std() < 0.4 * (light - threshold * rough).std()
