from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.core.events import checked
from sharpfield.events.image import window_image
from sharpfield.events.index import build_index
from sharpfield.geometry.trajectory import Still, Tracks, count_tracks
from sharpfield.simulation.cameras.rigs import (
    RING_FOCAL,
    StillCamera,
    Views,
    hand_held,
    ring,
    ring_pose,
)
from sharpfield.simulation.moving_capture import simulate_moving
from sharpfield.simulation.scenes.moving import ALONE, MOVING_SCENES, moving_scene
from sharpfield.simulation.sensors.event_pixels import LUMA, EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, view

RIG = Rig((32, 32), focal_of_width=RING_FOCAL)
SHORT = Timing(frames=5, exposure_us=0, interval_us=30_000, step_us=2500, test_every=2)
SHARP_CAMERAS = ring(3, held_out=2)


@pytest.fixture(scope="module")
def capture():
    return simulate_moving("spinner", SHARP_CAMERAS, rig=RIG, timing=SHORT, seed=3)


@pytest.mark.parametrize("name", MOVING_SCENES)
def test_scenes_are_within_their_bounds_and_move(name):
    place, camera = moving_scene(name), RIG.camera()
    for azimuth in (-90, 20, 140):
        images = []
        for time_s in (0.0, 0.21, 0.47, 0.8, 1.0):
            rgb, depth = view(place, camera, ring_pose(azimuth), time_s)
            thing = depth < 1e8
            assert place.near < depth.min() and depth[thing].max() < place.far
            assert 0.1 < thing.mean() < (0.3 if name in ALONE else 0.8)
            assert name not in ALONE or not (thing[[0, -1]].any() or thing[:, [0, -1]].any())
            images.append(rgb)
        changes = [np.abs(a - b).max(-1) > 0.02 for a, b in zip(images, images[1:], strict=False)]
        assert all(0.03 < change.mean() < 0.5 for change in changes)


def test_a_rig_is_whole(capture):
    frames, split = capture.needed_frames, capture.split
    assert len(frames) == 25 and isinstance(capture.trajectory, Still)
    np.testing.assert_array_equal(frames.track, np.repeat(np.arange(5), 5))
    np.testing.assert_array_equal(split.train, np.arange(15))
    np.testing.assert_array_equal(split.test, [16, 18, 21, 23])
    np.testing.assert_array_equal(
        np.unique(frames.exposure.open_us), 10_000 + 30_000 * np.arange(5)
    )
    events, test = capture.needed_events, capture.test_events
    for stream, tracks in ((events, (0, 1, 2)), (test, (3, 4))):
        checked(stream, "simulation")
        np.testing.assert_array_equal(np.unique(stream.track), tracks)
        assert len(stream) > 1000
    assert capture.known.thresholds.positive == 0.2 and "threshold_on_map" not in capture.notes


def test_truth_is_the_view_of_each_camera(capture):
    frames, place = capture.needed_frames, moving_scene("spinner")
    for i in (3, 12, 22):
        pose = capture.frame_pose(np.array([i]))[0].double().numpy()
        sharp, depth = view(place, capture.camera, pose, 1e-6 * frames.exposure.middle_us[i])
        expected = np.rint(255 * sharp ** (1 / 2.2))
        assert np.abs(frames.truth[i] - expected).max() <= 1
        thing = depth < 1e8
        np.testing.assert_allclose(frames.depth[i][thing], depth[thing], rtol=1e-4)
        assert np.isinf(frames.depth[i][~thing]).all()


def test_events_of_each_camera_explain_what_it_saw(capture):
    """Between two frames, for cameras to learn from and held-out ones alike."""
    frames, place = capture.needed_frames, moving_scene("spinner")
    start, end = 10_000, 130_000
    for track in range(5):
        stream = capture.needed_events if track < 3 else capture.test_events
        size = {"width": 32, "height": 32, "track": track}
        darker, brighter = np.moveaxis(window_image(build_index(stream), start, end, **size), -1, 0)
        pose = capture.trajectory.poses[track]
        logs = [
            np.log(view(place, capture.camera, pose, 1e-6 * t)[0] @ LUMA + 1e-5)
            for t in (start, end)
        ]
        told = 0.2 * (brighter - darker)
        assert np.abs(told - (logs[1] - logs[0])).max() < 0.41  # both ends are within a threshold
        assert np.abs(told).max() > 0.5
    assert frames.flow.shape == (25, 32, 32, 2) and np.abs(frames.flow).max() > 10


def test_what_stands_still_makes_no_events(capture):
    flow = np.abs(capture.needed_frames.flow).max((0, -1))
    place, pose = moving_scene("spinner"), capture.trajectory.poses[0]
    shots = [view(place, capture.camera, pose, t)[0] for t in np.arange(0, 0.15, 0.003)]
    still = np.ptp(np.stack(shots), axis=0).max(-1) == 0
    mine = capture.needed_events.of_track(0)
    fired = np.zeros((32, 32), bool)
    fired[mine.y, mine.x] = True
    assert still.mean() > 0.3 and not fired[still].any() and flow.max() > 0


def test_frames_are_blurry_when_asked():
    timing = replace(SHORT, exposure_us=28_000)
    made = simulate_moving("spinner", SHARP_CAMERAS, rig=RIG, timing=timing, seed=3)
    frames = made.needed_frames
    blurred = np.abs(frames.images.astype(int) - frames.truth).max((1, 2, 3))
    assert (blurred[:15] > 10).all() and (blurred[15:] == 0).all()
    assert set(frames.exposure.duration_us[:15]) == {28_000}
    assert frames.exposure.instant[15:].all()


def test_the_same_seed_gives_the_same_capture(capture):
    again = simulate_moving("spinner", SHARP_CAMERAS, rig=RIG, timing=SHORT, seed=3)
    np.testing.assert_array_equal(again.needed_events.t_us, capture.needed_events.t_us)
    np.testing.assert_array_equal(again.needed_frames.images, capture.needed_frames.images)


def test_cameras_of_a_real_sensor_differ():
    views = Views([StillCamera(ring_pose(-90))] * 2)
    rig = replace(RIG, event_sensor=EventSensor(threshold_sigma=0.03))
    made = simulate_moving("spinner", views, rig=rig, timing=SHORT)
    maps = made.notes["threshold_on_map"]
    assert maps.shape == (2, 32, 32) and np.abs(maps[0] - maps[1]).max() > 0.02
    assert made.test_events is None and len(made.split.test) == 0
    np.testing.assert_array_equal(made.needed_frames.images[:5], made.needed_frames.images[5:])


def test_a_carried_camera_is_a_moving_track():
    made = simulate_moving("jelly", hand_held("glide", held_out=2), rig=RIG, timing=SHORT)
    assert isinstance(made.trajectory, Tracks) and count_tracks(made.trajectory) == 3
    assert made.trajectory.known_us(0) == (0, made.clock.span_us)
    assert set(made.needed_events.track) == {0} and set(made.test_events.track) == {1, 2}
    near, far = made.frame_pose(np.array([0, 4]))[:, :, 3]
    assert (near - far).norm() > 0.1


def test_unknown_scenes_are_told():
    with pytest.raises(OptionError, match="use one of spinner, arm, jelly"):
        simulate_moving("garden")
