from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.core.events import checked
from sharpfield.simulation.cameras.motions import Motion, motion
from sharpfield.simulation.scenes.static import scene
from sharpfield.simulation.sensors.event_pixels import LUMA, EventSensor
from sharpfield.simulation.sensors.frames import FrameSensor
from sharpfield.simulation.static_capture import Rig, Timing, images, simulate, view

RIG = Rig((48, 32))
SHORT = Timing(frames=9, exposure_us=20_000, interval_us=25_000, step_us=2500)


@pytest.fixture(scope="module")
def capture():
    return simulate("tiles", "glide", rig=RIG, timing=SHORT, seed=4)


def test_a_capture_is_whole(capture):
    frames = capture.needed_frames
    assert len(frames) == 9 and frames.images.shape == (9, 32, 48, 3)
    np.testing.assert_array_equal(capture.split.test, [0, 8])
    np.testing.assert_array_equal(capture.split.train, np.arange(1, 8))
    np.testing.assert_array_equal(np.flatnonzero(frames.exposure.instant), [0, 8])
    np.testing.assert_array_equal(np.diff(frames.exposure.middle_us), 25_000)
    assert set(frames.exposure.duration_us[capture.split.train]) == {20_000}
    events = checked(capture.needed_events, "simulation")
    assert len(events) > 10_000
    known = capture.trajectory.known_us(0)
    assert known[0] <= events.t_us[0] and events.t_us[-1] <= known[1]
    assert capture.known.thresholds.positive == 0.2
    assert capture.notes["threshold_on_map"].shape == (32, 48)


def test_truth_is_the_view_at_mid_exposure(capture):
    frames, place = capture.needed_frames, scene("tiles")
    for i in (0, 3):
        pose = motion("glide", 4).poses(frames.exposure.middle_us[i : i + 1])[0]
        sharp = view(place, capture.camera, pose)[0]
        expected = np.rint(255 * sharp ** (1 / 2.2))
        assert np.abs(frames.truth[i].astype(int) - expected).max() <= 1
    np.testing.assert_array_equal(frames.truth[0], frames.images[0])


def test_a_still_camera_sees_sharp_frames_and_no_events():
    still = Motion(np.array([1.0]), np.zeros((1, 6)), np.zeros((1, 6)))
    capture = simulate("tiles", still, rig=RIG, timing=SHORT)
    frames = capture.needed_frames
    np.testing.assert_array_equal(frames.images, frames.truth)
    assert len(capture.needed_events) == 0


def test_blur_is_there_and_linear(capture):
    """A blurry frame is the mean of linear images, not of displayed ones."""
    frames = capture.needed_frames
    shown = [
        rgb
        for t_us, rgb in images(scene("tiles"), motion("glide", 4), capture.camera, SHORT)
        if frames.exposure.open_us[5] <= t_us <= frames.exposure.close_us[5]
    ]
    light = np.stack(shown).astype(float)
    weight = np.ones(len(light))
    weight[[0, -1]] = 0.5  # trapezoid
    assert weight.sum() == 8  # of 2.5 ms
    mean = np.average(light, axis=0, weights=weight)
    linear, bent = mean ** (1 / 2.2), np.average(light ** (1 / 2.2), axis=0, weights=weight)
    stored = frames.images[5] / 255
    assert np.abs(stored - linear).max() < 0.51 / 255 and np.abs(stored - bent).max() > 1.5 / 255
    assert np.abs(stored - frames.truth[5] / 255).max() > 0.03  # about a pixel of motion


def test_events_explain_the_change_between_sharp_views(capture):
    """Summed events between two instants are the difference of log luma, within a threshold."""
    frames = capture.needed_frames
    first, last = (int(frames.exposure.middle_us[i]) for i in (2, 6))
    path, place = motion("glide", 4), scene("tiles")
    logs = [
        np.log(view(place, capture.camera, path.poses(np.array([t]))[0])[0] @ LUMA + 1e-5)
        for t in (first, last)
    ]
    events, told = capture.needed_events.window(first + 1, last + 1), np.zeros((32, 48))
    np.add.at(told, (events.y, events.x), 0.2 * events.p)
    error = logs[1] - logs[0] - told
    assert np.abs(error).max() < 0.4 + 1e-3  # a rest of one threshold at each end
    assert np.abs(error).mean() < 0.15 < np.abs(logs[1] - logs[0]).mean()


def test_a_seed_is_a_capture(capture):
    again = simulate("tiles", "glide", rig=RIG, timing=SHORT, seed=4)
    np.testing.assert_array_equal(again.needed_frames.images, capture.needed_frames.images)
    np.testing.assert_array_equal(again.needed_events.t_us, capture.needed_events.t_us)


def test_finer_watching_adds_images_where_light_changes():
    few = Timing(frames=1, exposure_us=20_000, step_us=10_000, test_every=0)
    camera, place, path = RIG.camera(), scene("tiles"), motion("glide", 0)
    even = [t for t, _ in images(place, path, camera, few)]
    fine = [t for t, _ in images(place, path, camera, replace(few, most_change=0.7))]
    assert even == [0, 10_000, 20_000, 30_000, 40_000] and set(even) < set(fine)


def test_colour_noise_and_rolling_rows():
    rig = Rig(
        (48, 32),
        FrameSensor(full_well=1000.0, row_delay_us=50.0),
        EventSensor(bayer="RGGB", threshold_sigma=0.03, refractory_us=100.0, shot_hz=5.0),
    )
    capture = simulate("garden", "shaky", rig=rig, timing=replace(SHORT, frames=2, test_every=0))
    assert capture.needed_events.bayer == "RGGB" and len(capture.split.train) == 2
    assert capture.notes["row_delay_us"] == 50.0


def test_timing_says_what_is_wrong_with_it():
    with pytest.raises(OptionError, match="overlap\n  got    one of 50000 us every 40000 us"):
        Timing(interval_us=40_000)
    with pytest.raises(
        OptionError, match="must be positive, .* not negative\n  got    0, 50000 us"
    ):
        Timing(frames=0)
    with pytest.raises(OptionError, match="not negative\n  got    18, -1 us"):
        Timing(exposure_us=-1)
