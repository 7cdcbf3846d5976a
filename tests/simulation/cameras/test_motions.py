import numpy as np
import pytest
import torch

from sharpfield.core.capture import Clock
from sharpfield.core.errors import OptionError
from sharpfield.simulation.cameras.motions import MOTIONS, motion, stamped


@pytest.mark.parametrize("name", MOTIONS)
def test_poses_are_rigid_and_look_ahead(name):
    for seed in range(5):
        poses = motion(name, seed).poses(np.arange(0, 2_000_000, 7000))
        turn = poses[:, :, :3]
        identity = np.broadcast_to(np.eye(3), turn.shape)
        np.testing.assert_allclose(turn.transpose(0, 2, 1) @ turn, identity, atol=1e-12)
        assert (np.linalg.det(turn) > 0).all() and turn[:, 2, 2].min() > 0.98
        assert np.abs(poses[:, :, 3]).max() < 0.8


@pytest.mark.parametrize("name", MOTIONS)
def test_the_camera_seldom_rests(name):
    for seed in range(5):
        t = np.arange(0, 1_000_000, 1000)
        place = motion(name, seed).poses(t)[:, :2, 3]
        speed = np.linalg.norm(np.diff(place, axis=0), axis=1) * 1000  # units per second
        assert np.quantile(speed, 0.1) > 0.5 and speed.max() < 5


def test_the_stamps_carry_the_path():
    path, clock = motion("shaky", 3), Clock(20_000, 503_000)
    trajectory = stamped(path, clock)
    assert trajectory.known_us(0) == (20_000, 523_000)
    t = np.arange(20_000, 523_000, 1013)
    time = torch.from_numpy(clock.unit(t))
    got = trajectory.pose(time, torch.zeros(len(t), dtype=torch.int64)).numpy()
    expected = path.poses(t)
    assert np.abs(got - expected)[:, :, 3].max() < 1e-4
    assert np.abs(got - expected)[:, :, :3].max() < 1e-3


def test_a_seed_is_a_path():
    t = np.array([0, 123_456])
    np.testing.assert_array_equal(motion("glide", 2).poses(t), motion("glide", 2).poses(t))
    assert (motion("glide", 2).poses(t) != motion("glide", 3).poses(t)).any()


def test_faster_is_the_same_path_in_less_time():
    path, t = motion("shaky", 0), np.array([0, 40_000, 90_000])
    np.testing.assert_allclose(path.faster(2.0).poses(t), path.poses(2 * t), atol=1e-12)


def test_no_such_motion():
    with pytest.raises(
        OptionError, match="unknown motion\n  got    fall\n  do     use one of glide"
    ):
        motion("fall", 0)
