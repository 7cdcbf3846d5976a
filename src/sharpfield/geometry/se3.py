"""Rigid motions as `[*b 3 4]` tensors: three columns of rotation, then the translation.

`world_from_camera` maps camera coordinates to world coordinates. A twist is six numbers, first
the rotation vector (rad), then the translational part; `exp` maps it to a motion. Everything is
safe, in value and gradient, at the identity.
"""

import torch
from jaxtyping import Float
from torch import Tensor

SMALL = 1e-4
"""Angles squared below this use a series; its error is then below float32 resolution."""


def hat(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The matrix whose product with a point is the cross product `vector x point`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)


def _coefficients(theta2: Float[Tensor, "*b"]) -> tuple[Tensor, Tensor, Tensor]:
    """sin(t)/t, (1-cos t)/t^2 and (t-sin t)/t^3 from t^2."""
    small = theta2 < SMALL
    safe2 = torch.where(small, torch.ones_like(theta2), theta2)
    theta = safe2.sqrt()
    a = torch.where(small, 1 - theta2 / 6 + theta2**2 / 120, theta.sin() / theta)
    half = (theta / 2).sin()  # 1 - cos t would lose half the digits of small angles
    b = torch.where(small, 0.5 - theta2 / 24 + theta2**2 / 720, 2 * half * half / safe2)
    c = torch.where(
        small, 1 / 6 - theta2 / 120 + theta2**2 / 5040, (theta - theta.sin()) / (safe2 * theta)
    )
    return a, b, c


def rotation_exp(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by `|vector|` rad about the direction of `vector`."""
    a, b, _ = _coefficients((vector * vector).sum(-1))
    w = hat(vector)
    return _identity(vector) + a[..., None, None] * w + b[..., None, None] * (w @ w)


def rotation_log(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector of a rotation, of length at most pi."""
    wxyz = quaternion_from_rotation(rotation)
    wxyz = torch.where(wxyz[..., :1] < 0, -wxyz, wxyz)
    w, xyz = wxyz[..., 0], wxyz[..., 1:]
    sine2 = (xyz * xyz).sum(-1)
    small = sine2 < SMALL**2
    sine = torch.where(small, torch.ones_like(sine2), sine2).sqrt()
    scale = torch.where(small, 2 / w.clamp_min(0.5), 2 * torch.atan2(sine, w) / sine)
    return scale[..., None] * xyz


def exp(twist: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 4"]:
    """The motion of following a twist for unit time (exponential map of SE(3))."""
    vector, velocity = twist[..., :3], twist[..., 3:]
    a, b, c = (x[..., None, None] for x in _coefficients((vector * vector).sum(-1)))
    w = hat(vector)
    w2 = w @ w
    rotation = _identity(vector) + a * w + b * w2
    translation = (_identity(vector) + b * w + c * w2) @ velocity[..., None]
    return torch.cat([rotation, translation], -1)


def log(pose: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 6"]:
    """The twist that leads to a motion in unit time; rotation below pi."""
    vector = rotation_log(pose[..., :3])
    theta2 = (vector * vector).sum(-1)
    a, b, _ = _coefficients(theta2)
    small = theta2 < SMALL
    safe2 = torch.where(small, torch.ones_like(theta2), theta2)
    last = torch.where(small, 1 / 12 + theta2 / 720, (1 - a / (2 * b)) / safe2)
    w = hat(vector)
    inverse = _identity(vector) - 0.5 * w + last[..., None, None] * (w @ w)
    return torch.cat([vector, (inverse @ pose[..., 3:])[..., 0]], -1)


def compose(
    first: Float[Tensor, "*b 3 4"], second: Float[Tensor, "*#b 3 4"]
) -> Float[Tensor, "*b 3 4"]:
    """`a_from_c` from `a_from_b` and `b_from_c`."""
    rotation = first[..., :3] @ second[..., :3]
    translation = first[..., :3] @ second[..., 3:] + first[..., 3:]
    return torch.cat([rotation, translation], -1)


def inverse(pose: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3 4"]:
    """`b_from_a` from `a_from_b`."""
    back = pose[..., :3].transpose(-1, -2)
    return torch.cat([back, -back @ pose[..., 3:]], -1)


def act(pose: Float[Tensor, "*b 3 4"], points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Move points."""
    return rotate(pose, points) + pose[..., 3]


def rotate(pose: Float[Tensor, "*b 3 4"], vectors: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Turn directions."""
    return (pose[..., :3] @ vectors[..., None])[..., 0]


def quaternion_from_rotation(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion (w, x, y, z) of a rotation; the sign is arbitrary.

    The largest of the four components is computed first, so nothing is divided by a small number.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    a, b, c = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    d, e, f = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    rows = torch.stack(
        [
            torch.stack([squares[0], a - d, b - e, c - f], -1),
            torch.stack([a - d, squares[1], c + f, b + e], -1),
            torch.stack([b - e, c + f, squares[2], a + d], -1),
            torch.stack([c - f, b + e, a + d, squares[3]], -1),
        ],
        -2,
    )
    best = squares.argmax(0)[..., None, None].expand(*rotation.shape[:-2], 1, 4)
    return torch.nn.functional.normalize(rows.gather(-2, best)[..., 0, :], dim=-1)


def rotation_from_quaternion(wxyz: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation of a quaternion (w, x, y, z), which is normalised first."""
    unit = torch.nn.functional.normalize(wxyz, dim=-1)
    w = hat(unit[..., 1:])
    return _identity(unit[..., 1:]) + 2 * unit[..., :1, None] * w + 2 * (w @ w)


def _identity(like: Float[Tensor, "*b 3"]) -> Float[Tensor, "3 3"]:
    return torch.eye(3, dtype=like.dtype, device=like.device)
