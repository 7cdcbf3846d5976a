"""Light that moves in ramps from event to event."""

import math

import numpy as np
import pytest
import torch

from sharpfield.core.events import EventStream
from sharpfield.events.counts import EventMotion
from sharpfield.events.index import EventIndex, build_index
from sharpfield.events.latent_frames import LatentFrames, SensorEstimate
from sharpfield.events.ramps import OVERSHOOT, RAMP_US, ramp_at, ramped_log_mean
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.storage.event_cache import event_index

SIZE = (2, 1)
NEGATIVE, POSITIVE = 0.2, 0.3


def index_of(*events: tuple[int, int]) -> EventIndex:
    """Events (time in us, polarity) of the second of two pixels."""
    t_us, p = np.array(events).T
    ones, zeros = np.ones(len(p), np.int16), np.zeros(len(p), np.int16)
    return build_index(EventStream(ones, zeros, t_us, p.astype(np.int8), width=2, height=1))


def level(index: EventIndex, time_us: int) -> float:
    """Log light since the beginning, whole steps and the ramp."""
    past = index.p[index.t_us <= time_us]
    parts = ramp_at(index, time_us, SIZE)[0, 1]
    whole = POSITIVE * (past > 0).sum() - NEGATIVE * (past < 0).sum()
    return float(whole + POSITIVE * parts[1] + NEGATIVE * parts[0])


TURNS = (5_000, 1), (8_000, 1), (9_000, -1)
CORNERS = {
    -2_000: 0.0, 5_000: 0.3, 8_000: 0.6, 8_000.001: 0.7, 9_000: 0.4, 9_000.001: 0.4 - 0.2 / 3
}  # fmt: skip
"""The light of these events: beyond the second and the third by a third of a threshold."""


def light(times: np.ndarray) -> np.ndarray:
    """Log light of `TURNS`."""
    return np.interp(times, list(CORNERS), list(CORNERS.values()))


def test_light_ramps_to_each_event_and_overshoots_where_it_turns() -> None:
    index = index_of(*TURNS)
    times = np.arange(5, 12_000, 10)
    levels = np.array([level(index, int(t)) for t in times])
    assert levels == pytest.approx(light(times), abs=1e-6)


def test_what_moves_slower_stood_still_before() -> None:
    """A little beyond the last event, until the ramp to the next."""
    index = index_of((1_000, 1), (50_000, 1))
    beyond = OVERSHOOT / 2
    assert level(index, 20_000) == pytest.approx((1 + beyond) * POSITIVE)
    assert level(index, 50_000 - RAMP_US) == pytest.approx((1 + beyond) * POSITIVE)
    assert level(index, 50_000 - RAMP_US // 2) == pytest.approx((1.5 + beyond / 2) * POSITIVE)
    assert (ramp_at(index, 0, SIZE)[0, 0] == 0).all()


@pytest.mark.parametrize("window", [(0, 12_000), (4_000, 7_000), (8_500, 8_700), (20_000, 30_000)])
def test_the_mean_is_that_of_many_instants(window: tuple[int, int]) -> None:
    index = index_of(*TURNS)
    times = np.linspace(*window, 4001)[:-1] + (window[1] - window[0]) / 8000
    wanted = math.log(np.exp(light(times) - level(index, window[0])).mean())
    found = ramped_log_mean(index, window, (NEGATIVE, POSITIVE), SIZE)
    assert found[0, 0, 0] == 0
    assert float(found[0, 1, 0]) == pytest.approx(wanted, abs=1e-4)


def test_an_exposure_of_no_length_has_no_mean() -> None:
    index = index_of((5_000, 1))
    assert (ramped_log_mean(index, (3_000, 3_000), (NEGATIVE, POSITIVE), SIZE) == 0).all()


def test_images_with_ramps_are_nearer_the_truth() -> None:
    """Stairs show where things were a moment ago."""
    timing = Timing(frames=3, exposure_us=40_000, interval_us=50_000, step_us=500, test_every=0)
    capture = simulate("tiles", "shaky", rig=Rig((36, 24)), timing=timing, seed=1)
    frames, moving = capture.needed_frames, EventMotion.of(capture)
    assert frames.truth is not None
    index, off = event_index(capture.needed_events), []
    for used in (None, index):
        made = LatentFrames(capture, moving, used)
        found = [made.at(int(t), SensorEstimate(0.2, 0.2)) for t in frames.exposure.middle_us]
        truth = torch.from_numpy(frames.truth / np.float32(frames.white))
        off.append(float((torch.stack(found) - truth).square().mean()))
    assert off[1] < 0.8 * off[0]
