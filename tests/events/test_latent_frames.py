"""Sharp images at any time, against the light of the simulated scene itself."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.tone import tone_of
from sharpfield.events.counts import EventMotion
from sharpfield.events.latent_frames import LatentFrames, SensorEstimate
from sharpfield.simulation.cameras.motions import motion
from sharpfield.simulation.scenes.static import scene
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate, view

THRESHOLD = 0.04
BELIEF = SensorEstimate(THRESHOLD, THRESHOLD)
SENSOR = EventSensor(threshold_on=THRESHOLD, threshold_off=THRESHOLD)
TIMING = Timing(frames=4, exposure_us=40_000, interval_us=60_000, step_us=500, test_every=0)
SEED = 1


@functools.cache
def recorded() -> Capture:
    """Without noise, 20 ms between exposures."""
    return simulate("tiles", rig=Rig((24, 16), event_sensor=SENSOR), timing=TIMING, seed=SEED)


def instants(capture: Capture) -> LatentFrames:
    return LatentFrames(capture, EventMotion.of(capture))


def at(made: LatentFrames, t_us: int, late_us: int = 0) -> Tensor:
    return made.at(t_us, SensorEstimate(THRESHOLD, THRESHOLD, late_us))


def truth(t_us: int) -> Tensor:
    """What a frame of no length would store."""
    pose = motion("glide", SEED).poses(np.array([t_us]))[0]
    light = view(scene("tiles"), recorded().camera, pose, 1e-6 * t_us)[0]
    return tone_of(recorded().needed_frames.encoding).encode(torch.from_numpy(light).clamp(0, 1))


def off(found: Tensor, wanted: Tensor) -> float:
    return (found - wanted).abs().mean().item()


def opens(frame: int) -> int:
    return int(recorded().needed_frames.exposure.open_us[frame])


@pytest.mark.parametrize(("frame", "after"), [(0, 0), (1, 7_000), (2, 33_000), (3, 40_000)])
def test_inside_an_exposure_it_is_the_sharp_view(frame: int, after: int) -> None:
    t_us = opens(frame) + after
    found = at(instants(recorded()), t_us)
    frames = recorded().needed_frames
    blurred = torch.from_numpy(frames.images[frame] / np.float32(frames.white))
    assert found.shape == (16, 24, 3)
    assert off(found, truth(t_us)) < 0.006
    assert off(blurred, truth(t_us)) > 2 * off(found, truth(t_us))


@pytest.mark.parametrize("after", [41_000, 50_000, 58_000])
def test_between_two_exposures_it_is_the_sharp_view(after: int) -> None:
    t_us = opens(1) + after
    assert off(at(instants(recorded()), t_us), truth(t_us)) < 0.005


@pytest.mark.parametrize("border", [40_000, 60_000])
def test_where_an_exposure_begins_or_ends_nothing_jumps(border: int) -> None:
    """Just outside, the exposure that is near counts for nearly all."""
    made, t_us = instants(recorded()), opens(1) + border
    step = 1 if border == 40_000 else -1
    assert off(at(made, t_us), at(made, t_us + step)) < 2e-4


def test_half_way_both_neighbours_count_alike() -> None:
    made, t_us = instants(recorded()), opens(1) + 50_000
    alone = []
    for frame in (1, 2):
        only = np.array([frame])
        capture = replace(recorded(), split=replace(recorded().split, train=only))
        alone.append(at(instants(capture), t_us))
    one, other = (tone_of("gamma2.2").decode(image).log() for image in alone)
    mean = tone_of("gamma2.2").encode(((one + other) / 2).exp())
    unclipped = (alone[0] < 1) & (alone[1] < 1)
    assert unclipped.float().mean() > 0.9
    torch.testing.assert_close(at(made, t_us)[unclipped], mean[unclipped], atol=1e-4, rtol=0)


@pytest.mark.parametrize("late_us", [3_000, -5_000])
@pytest.mark.parametrize("after", [10_000, 50_000])
def test_a_late_clock_of_the_events_is_undone(late_us: int, after: int) -> None:
    capture, t_us = recorded(), opens(1) + after
    events = capture.needed_events
    late = instants(replace(capture, events=replace(events, t_us=events.t_us + late_us)))
    wanted = instants(capture).at(t_us, BELIEF)
    torch.testing.assert_close(late.at(t_us, replace(BELIEF, late_us=late_us)), wanted)
    assert off(late.at(t_us, BELIEF), wanted) > 1e-3


def test_what_was_believed_before_does_not_matter() -> None:
    made, t_us = instants(recorded()), opens(1) + 10_000
    first = made.at(t_us, BELIEF)
    other = made.at(t_us, SensorEstimate(0.06, 0.02))
    assert off(other, truth(t_us)) > 1.5 * off(first, truth(t_us))
    assert torch.equal(made.at(t_us, BELIEF), first)
    assert torch.equal(instants(recorded()).at(t_us, SensorEstimate(0.06, 0.02)), other)


def test_images_are_asked_for_between_the_first_and_the_last_exposure() -> None:
    assert instants(recorded()).span_us == (opens(0), opens(3) + 40_000)
    capture = replace(recorded(), split=replace(recorded().split, train=np.array([2, 1])))
    assert instants(capture).span_us == (opens(1), opens(2) + 40_000)


def test_without_events_it_is_the_blurred_frame() -> None:
    capture = replace(recorded(), events=recorded().needed_events[:0])
    frames = capture.needed_frames
    stored = torch.from_numpy(frames.images[1] / np.float32(frames.white))
    torch.testing.assert_close(at(instants(capture), opens(1)), stored, atol=0.012, rtol=0)
