"""A rig seen from its middle."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.geometry.normalise import recentred
from sharpfield.geometry.trajectory import Still
from tests.recipes.moving import tiny_moving


def test_what_a_ring_looks_at_fills_the_box():
    """Cameras 4 away with a lens of 50 mm on 36 mm see 1.44 to each side."""
    made, change = recentred(tiny_moving())
    assert change.scale == pytest.approx(1 / (4 * 36 / 50 / 2))
    np.testing.assert_allclose(change.translation, 0, atol=1e-6)
    pose = made.trajectory.pose(torch.zeros(()), torch.tensor(0))
    assert float(pose[:, 3].norm()) == pytest.approx(4 * change.scale, rel=1e-5)
    assert made.near == pytest.approx(tiny_moving().near * change.scale)


def test_the_box_begins_behind_the_nearest_depth():
    near = replace(tiny_moving(), near=3.5, far=6.5)
    _, change = recentred(near)
    assert change.scale == pytest.approx(1 / 0.5, rel=1e-5)


def test_parallel_cameras_look_at_the_middle_depth():
    poses = np.tile(np.eye(3, 4), (4, 1, 1))
    poses[:, 0, 3] = (0, 0.1, 0.2, 0.3)
    capture = replace(tiny_moving(), trajectory=Still(poses), near=2.0, far=6.0)
    capture = capture.without(frames=True)
    _, change = recentred(capture)
    np.testing.assert_allclose(-change.translation / change.scale, (0.15, 0, 4.0), atol=1e-6)
