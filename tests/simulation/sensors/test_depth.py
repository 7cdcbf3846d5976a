from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.camera import Camera
from sharpfield.core.errors import OptionError
from sharpfield.simulation.cameras.rigs import walk
from sharpfield.simulation.room_capture import ROOM_SENSORS, RoomSensors, RoomTiming, simulate_room
from sharpfield.simulation.sensors.frames import DepthSensor, drifting
from sharpfield.simulation.static_capture import Rig

CAMERA = Camera(160, 120, 150.0, 150.0, 80.0, 60.0)
NOISY = DepthSensor(noise=0.0014)


def wall(depth: float) -> np.ndarray:
    return np.full((120, 160), depth, np.float32)


def test_noise_grows_with_the_square_of_depth():
    for depth in (1.0, 2.0, 4.0):
        seen = NOISY.measure(wall(depth), CAMERA, np.random.default_rng(0))
        assert seen[2:-2, 2:-2].std() == pytest.approx(0.0014 * depth**2, rel=0.1)
        assert seen.mean() == pytest.approx(depth, abs=0.002)


def test_nothing_is_measured_far_off_or_beside_edges():
    assert not NOISY.measure(wall(5.5), CAMERA, np.random.default_rng(0)).any()
    step = wall(2.0)
    step[:, 80:] = 3.0
    seen = NOISY.seen(step, CAMERA)
    assert not seen[:, 79:81].any() and seen[:, :78].all() and seen[:, 82:].all()


def test_floors_are_measured_until_they_are_seen_at_a_grazing_angle():
    """A floor 1 m below: the cosine of the angle to its normal is 1 m over the distance."""
    row = (np.arange(120) + 0.5 - 60) / 150
    depth = np.where(row > 0.01, 1 / np.maximum(row, 0.01), 100.0)
    floor = np.repeat(depth[:, None], 160, 1).astype(np.float32)
    seen = replace(NOISY, farthest=1000.0).seen(floor, CAMERA)[:, 80]
    distance = depth * np.sqrt(1 + row**2)
    steep = np.arccos(1 / distance[row > 0.01])
    np.testing.assert_array_equal(seen[row > 0.01][:-1], (np.rad2deg(steep) < 78)[:-1])


def test_paths_drift_slowly_and_by_as_much_as_asked():
    path, times = walk(60_000_000, 1), np.arange(0, 60_000_000, 100_000)
    assert drifting(path, 0.0, 1) is path
    moved = drifting(path, 0.05, 1).poses(times) - path.poses(times)
    off = np.linalg.norm(moved[..., 3], axis=-1)
    assert 0.005 < off.max() < 0.1
    assert np.linalg.norm(np.diff(moved[..., 3], axis=0), axis=-1).max() < 0.005


def test_the_room_is_exact_unless_told():
    rig, timing = Rig(size=(32, 24)), RoomTiming(frames=3)
    exact = simulate_room(rig=rig, timing=timing, seed=2)
    again = simulate_room(rig=rig, timing=timing, sensors=ROOM_SENSORS, seed=2)
    np.testing.assert_array_equal(exact.depth.stored, again.depth.stored)
    known = RoomSensors(NOISY, drift=0.03)
    noisy = simulate_room(rig=rig, timing=timing, sensors=known, seed=2)
    np.testing.assert_array_equal(noisy.frames.images, exact.frames.images)
    there = noisy.depth.stored > 0
    assert 0.2 < there.mean() < 1
    off = noisy.depth.stored[there].astype(int) - exact.depth.stored[there]
    assert 0 < np.abs(off).max() < 200
    frames = np.arange(3)
    moved = (noisy.frame_pose(frames) - exact.frame_pose(frames)).abs().max()
    assert 1e-4 < moved < 0.1


def test_noise_has_bounds():
    with pytest.raises(OptionError, match="noise of depth lies between 0 and 0.1 m"):
        DepthSensor(noise=0.5)
