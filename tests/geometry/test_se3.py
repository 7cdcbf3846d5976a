import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch import Tensor

from sharpfield.geometry import se3
from tests.geometry.toy import points, poses, twists

ANGLES = [0.0, 1e-12, 1e-7, 1e-4, 9.9e-3, 1e-2, 1.01e-2, 0.5, 3.0, math.pi - 1e-3, math.pi - 1e-7]
"""Also around the angle where series end, and near a half turn."""


def turning(angle: float, *, count: int = 20) -> Tensor:
    """Twists of one angle about any axes."""
    made = twists(count)
    axis = made[:, :3] / made[:, :3].norm(dim=-1, keepdim=True)
    return torch.cat([angle * axis, made[:, 3:]], -1)


def matrix(pose: Tensor) -> Tensor:
    """4 x 4."""
    last = torch.tensor([0, 0, 0, 1.0], dtype=pose.dtype).expand(*pose.shape[:-2], 1, 4)
    return torch.cat([pose, last], -2)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle: float):
    twist = turning(angle)
    torch.testing.assert_close(se3.log(se3.exp(twist)), twist, rtol=0, atol=1e-8)


@pytest.mark.parametrize("angle", [*ANGLES, math.pi, 4.0, 7.0])
def test_exp_undoes_log(angle: float):
    pose = se3.exp(turning(angle))
    torch.testing.assert_close(se3.exp(se3.log(pose)), pose, rtol=0, atol=1e-8)
    assert (se3.rotation_log(pose[..., :3]).norm(dim=-1) <= math.pi + 1e-12).all()


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [-1, 2, 3]])
def test_a_half_turn_about_any_axis(axis: list[float]):
    direction = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    rotation = 2 * torch.outer(direction, direction) - torch.eye(3, dtype=torch.float64)
    vector = se3.rotation_log(rotation)
    assert vector.norm().item() == pytest.approx(math.pi)
    torch.testing.assert_close(se3.rotation_exp(vector), rotation)


def test_motions_are_a_group():
    a, b, c = (poses(9, stream=name) for name in "abc")
    left, right = se3.compose(se3.compose(a, b), c), se3.compose(a, se3.compose(b, c))
    torch.testing.assert_close(left, right)
    still = torch.eye(3, 4, dtype=torch.float64).expand(9, 3, 4)
    torch.testing.assert_close(se3.compose(a, se3.inverse(a)), still)
    torch.testing.assert_close(se3.compose(se3.inverse(a), a), still)
    torch.testing.assert_close(se3.compose(a, still), a)


def test_acting_is_acting_in_turn():
    a, b, x = poses(9, stream="a"), poses(9, stream="b"), points(9)
    torch.testing.assert_close(se3.act(se3.compose(a, b), x), se3.act(a, se3.act(b, x)))
    torch.testing.assert_close(se3.act(se3.inverse(a), se3.act(a, x)), x)
    torch.testing.assert_close(se3.rotate(a, x), se3.act(a, x) - a[..., 3])


def test_following_a_twist_twice_as_long():
    twist = twists(9, turn=0.7)
    once = se3.exp(twist)
    torch.testing.assert_close(se3.exp(2 * twist), se3.compose(once, once))


def test_rotations_are_orthonormal_and_right_handed():
    rotation = se3.rotation_exp(twists(50, turn=4.0)[:, :3])
    torch.testing.assert_close(
        rotation.mT @ rotation, torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    )
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(50, dtype=torch.float64))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float):
    for twist in turning(angle, count=5):
        generator = torch.zeros(4, 4, dtype=torch.float64)
        generator[:3, :3], generator[:3, 3] = se3.hat(twist[:3]), twist[3:]
        np.testing.assert_allclose(matrix(se3.exp(twist)), expm(generator.numpy()), atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_single_precision_loses_nothing_more(angle: float):
    twist = turning(angle).float()
    exact = se3.exp(twist.double())
    torch.testing.assert_close(se3.exp(twist).double(), exact, rtol=0, atol=1.5e-6)


def test_hat_is_the_cross_product():
    a, b = points(2, 9)
    torch.testing.assert_close((se3.hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


def test_quaternions_are_scipys():
    rotation = poses(200, turn=3.1)[..., :3]
    wanted = Rotation.from_matrix(rotation.numpy()).as_quat()[:, [3, 0, 1, 2]]
    found = se3.quaternion_from_rotation(rotation).numpy()
    found *= np.sign((found * wanted).sum(-1, keepdims=True))
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    back = se3.rotation_from_quaternion(torch.from_numpy(wanted))
    torch.testing.assert_close(back, rotation)


def test_a_quaternion_is_normalised_first_and_its_sign_does_not_matter():
    wxyz = torch.randn(9, 4, dtype=torch.float64)
    rotation = se3.rotation_from_quaternion(wxyz)
    torch.testing.assert_close(se3.rotation_from_quaternion(-3 * wxyz), rotation)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.5, math.pi - 1e-3])
def test_gradients(angle: float):
    twist = turning(angle, count=2).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp, (twist,))
    assert torch.autograd.gradcheck(se3.rotation_exp, (twist[:, :3],))
    assert torch.autograd.gradcheck(lambda t: se3.log(se3.exp(t)), (twist,), atol=1e-4)


def test_gradients_of_quaternions():
    wxyz = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(se3.rotation_from_quaternion, (wxyz,))
    rotation = poses(3)[..., :3].requires_grad_()
    assert torch.autograd.gradcheck(se3.quaternion_from_rotation, (rotation,))


def test_many_and_none():
    pose = poses(2, 1, 3)
    assert se3.log(pose).shape == (2, 1, 3, 6)
    assert se3.compose(pose, pose[:, :, :1]).shape == (2, 1, 3, 3, 4)
    assert se3.log(pose[:0]).shape == (0, 1, 3, 6)
    assert se3.exp(torch.zeros(0, 6)).shape == (0, 3, 4)
