import math

import pytest
import torch

from sharpfield.core.errors import ShapeError
from sharpfield.geometry.se3 import compose, exp
from sharpfield.metrics.pose import absolute_error, align, relative_error


def path(count: int = 12) -> torch.Tensor:
    twist = torch.randn(count, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return exp(twist * 0.7)


def moved(poses: torch.Tensor, scale: float) -> torch.Tensor:
    """The same path seen from another world, with another unit of length."""
    scaled = torch.cat([poses[..., :3], scale * poses[..., 3:]], -1)
    world = exp(torch.tensor([0.3, -0.8, 1.9, 4.0, -2.0, 0.5], dtype=torch.float64))
    return compose(world.expand(len(poses), 3, 4), scaled)


@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_a_similarity_is_found_and_leaves_no_error(scale: float):
    found = align(moved(path(), scale), path())
    assert found.scale == pytest.approx(1 / scale)
    error = absolute_error(moved(path(), scale), path())
    assert error.translation == pytest.approx(0, abs=1e-9)
    assert error.rotation_deg == pytest.approx(0, abs=1e-5)
    error = relative_error(moved(path(), scale), path(), stride=2)
    assert error.translation == pytest.approx(0, abs=1e-9)


def test_a_mirrored_path_is_not_called_aligned():
    """The best rotation of a mirror image is a rotation, not a reflection."""
    mirrored = path().clone()
    mirrored[..., 0, 3] *= -1
    found = align(mirrored, path())
    assert torch.linalg.det(found.rotation).item() == pytest.approx(1)
    assert absolute_error(mirrored, path()).translation > 0.1


def test_a_turn_of_every_camera_is_a_rotation_error():
    turn = exp(torch.tensor([0.0, math.radians(3), 0, 0, 0, 0], dtype=torch.float64))
    turned = compose(path(), turn.expand(12, 3, 4))
    error = absolute_error(turned, path())
    assert error.rotation_deg == pytest.approx(3, abs=1e-6)
    assert error.translation == pytest.approx(0, abs=1e-9)


def test_two_poses_do_not_fix_a_similarity():
    with pytest.raises(ShapeError, match="at least three pairs"):
        align(path(2), path(2))
