"""Formation and simulation share no code, so each says whether the other is right.

A small recording is simulated; then what the frames and events say is predicted from the scene's
true light, through the exposures, trajectory and thresholds of the capture alone.
"""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.tone import tone_of
from sharpfield.events.index import build_index
from sharpfield.events.threshold import FixedThresholds
from sharpfield.formation.events import LogContrast
from sharpfield.formation.response import FixedResponse
from sharpfield.formation.shutter import Shutter
from sharpfield.losses.photometric import mse
from sharpfield.sampling.pixels_and_pairs import draw_pairs, draw_pixels, pair_table, pixel_table
from sharpfield.simulation.scenes.static import scene
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate

SENSOR = EventSensor(threshold_on=0.25, threshold_off=0.15)
RIG = Rig(size=(30, 20), event_sensor=SENSOR)
TIMING = Timing(frames=4, exposure_us=60_000, interval_us=64_000, test_every=0)


@functools.cache
def recorded(bayer: str = "") -> Capture:
    rig = replace(RIG, event_sensor=replace(SENSOR, bayer=bayer))
    return simulate("garden", "glide", rig=rig, timing=TIMING, seed=1)


def truth(rays: Rays) -> Radiance:
    """The scene's own light."""
    origin, direction = (x.reshape(-1, 3).double().numpy() for x in (rays.origin, rays.direction))
    footprint = 1 / recorded().camera.fx_px
    rgb, depth = scene("garden").light(origin, direction, footprint_rad=footprint)
    light = torch.from_numpy(rgb).reshape(*rays.shape, 3)
    depth = torch.from_numpy(depth).reshape(rays.shape)
    return Radiance(light, depth, torch.ones_like(depth), rays.weight)


def test_blurry_frames_are_the_mean_of_true_light():
    capture = recorded()
    seen = draw_pixels(pixel_table(capture), 400, seed=0, step=0)
    tone = tone_of(capture.needed_frames.encoding).encode
    errors = {}
    for samples in (1, 60):
        shutter = Shutter(capture.camera, capture.trajectory, samples, tone)
        predicted = shutter.observe(truth(shutter.expose(seen)), seen)
        errors[samples] = mse(predicted, seen.value).sqrt().item()
    assert errors[60] < 0.35 / 255  # rounding to 8 bits alone makes 0.29
    assert errors[1] > 5 * errors[60]


@pytest.mark.parametrize("bayer", ["", "RGGB"])
def test_events_are_the_change_of_true_log_light(bayer):
    capture = recorded(bayer)
    table = pair_table(capture, build_index(capture.needed_events))
    seen = draw_pairs(table, 2000, seed=0, step=0)
    contrast = LogContrast(capture.camera, capture.trajectory, FixedResponse())
    predicted = contrast.observe(truth(contrast.expose(seen)), seen)[:, 0]
    thresholds = FixedThresholds(SENSOR.threshold_off, SENSOR.threshold_on)
    wrong = (predicted - seen.measured(*thresholds(seen))).abs()
    assert np.median(wrong) < 0.01
    swapped = FixedThresholds(SENSOR.threshold_on, SENSOR.threshold_off)
    assert (predicted - seen.measured(*swapped(seen))).abs().median() > 0.05
