"""Thresholds measured from frames and events are those of the sensor."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.preparation.calibrate.measure import (
    ThresholdCalibration,
    calibrate,
    calibration_text,
    write_calibration,
)
from sharpfield.preparation.options import CalibrateOptions
from sharpfield.simulation.sensors.event_pixels import SENSORS, EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.storage.arrays import load_arrays

ON, OFF = 0.25, 0.3
TIMING = Timing(frames=6, exposure_us=40_000, interval_us=56_000, step_us=2000, test_every=0)


@lru_cache
def ideal() -> Capture:
    sensor = EventSensor(threshold_on=ON, threshold_off=OFF)
    rig = Rig(size=(96, 64), event_sensor=sensor)
    return simulate("garden", "glide", rig=rig, timing=TIMING, seed=5)


@lru_cache
def noisy() -> Capture:
    sensor = replace(SENSORS["dvs346"], threshold_on=ON, threshold_off=OFF)
    rig = Rig(size=(96, 64), event_sensor=sensor)
    return simulate("garden", "glide", rig=rig, timing=TIMING, seed=6)


@lru_cache
def measured() -> ThresholdCalibration:
    return calibrate(ideal(), CalibrateOptions())


def test_both_thresholds_of_an_ideal_sensor_are_found() -> None:
    assert measured().positive == pytest.approx(ON, rel=0.05)
    assert measured().negative == pytest.approx(OFF, rel=0.05)
    assert measured().explained > 0.95
    assert measured().dead_us < 30


def test_a_sensor_with_noise_is_found_within_a_few_percent() -> None:
    """Spread thresholds, leak, shot noise, a dead time of 200 us, a low-pass."""
    found = calibrate(noisy(), CalibrateOptions())
    assert found.positive == pytest.approx(ON, rel=0.05)
    assert found.negative == pytest.approx(OFF, rel=0.05)
    assert found.dead_us == pytest.approx(200, abs=100)
    assert 0.5 < found.late_ms < 5
    assert 0 < found.positive_sigma < 0.05 * ON


def test_thresholds_scale_with_the_light_of_the_frames() -> None:
    """Counts are what they are: if frames say half the change, thresholds are half as large."""
    frames = ideal().needed_frames
    stored = frames.images.astype(np.float64) / 255
    flatter = np.rint(255 * stored**0.5).astype(np.uint8)
    found = calibrate(replace(ideal(), frames=replace(frames, images=flatter)), CalibrateOptions())
    assert found.positive / measured().positive == pytest.approx(0.5, rel=0.08)


def test_sensitive_pixels_deviate_and_stay_out_of_the_common_threshold() -> None:
    """Twice as many events for the same light: half the threshold."""
    events = ideal().needed_events
    inside = np.zeros((64, 96), bool)
    inside[20:24, 40:44] = True
    twice = np.repeat(np.arange(len(events)), 1 + inside[events.y, events.x])
    more = replace(
        events, x=events.x[twice], y=events.y[twice], t_us=events.t_us[twice], p=events.p[twice]
    )
    found = calibrate(replace(ideal(), events=more), CalibrateOptions())
    assert np.nanmedian(found.ratio[inside]) == pytest.approx(0.5, abs=0.1)
    assert found.deviating[inside].mean() > 0.3 > 0.02 > found.deviating[~inside].mean()
    assert found.positive == pytest.approx(measured().positive, rel=0.02)


def test_the_same_seed_gives_the_same_uncertainty() -> None:
    again = calibrate(ideal(), CalibrateOptions())
    assert again.positive_sigma == measured().positive_sigma


def test_files_say_what_was_measured(tmp_path: Path) -> None:
    about = write_calibration(ideal(), measured(), tmp_path / "out")
    assert about["threshold"]["positive"]["value"] == round(measured().positive, 5)
    arrays = load_arrays(tmp_path / "out" / "pixels.npz")
    assert arrays["ratio"].shape == (64, 96) and arrays["dead"].dtype == bool
    assert (tmp_path / "out" / "pixels.png").stat().st_size > 500
    assert "stated in the capture: 0.25" in calibration_text(about)


def test_a_scene_that_stands_still_is_refused() -> None:
    frames = ideal().needed_frames
    still = replace(frames, images=np.repeat(frames.images[:1], len(frames), 0))
    with pytest.raises(CaptureError, match="too little changed"):
        calibrate(replace(ideal(), frames=still), CalibrateOptions())


def test_events_alone_are_refused() -> None:
    with pytest.raises(CaptureError, match="needs frames"):
        calibrate(ideal().without(frames=True), CalibrateOptions())
