"""Errors of an estimated trajectory against a known one.

Poses are world-from-camera `[n 3 4]`. An estimate from images alone is known only up to a
similarity (Sim(3)); `align` finds the one that brings the camera centres together.

Source: Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", TPAMI 1991; Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems",
IROS 2012, for the two errors.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.errors import ShapeError
from sharpfield.geometry.se3 import compose, inverse


@dataclass(frozen=True)
class Alignment:
    """truth is about scale * rotation @ estimate + translation."""

    scale: float
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    def __call__(self, poses: Float[Tensor, "n 3 4"]) -> Float[Tensor, "n 3 4"]:
        """Poses of the estimate, in the frame of the truth."""
        turned = self.rotation @ poses[..., :3]
        centre = self.scale * poses[..., 3] @ self.rotation.T + self.translation
        return torch.cat([turned, centre[..., None]], -1)


@dataclass(frozen=True)
class PoseError:
    """Root mean square errors over a trajectory."""

    translation: float
    """In units of the truth."""
    rotation_deg: float


def align(estimate: Float[Tensor, "n 3 4"], truth: Float[Tensor, "n 3 4"]) -> Alignment:
    """The similarity that brings the camera centres of an estimate closest to the truth.

    Raises:
        ShapeError: Fewer than three poses, which do not fix a similarity.
    """
    if len(estimate) != len(truth) or len(truth) < 3:
        raise ShapeError(
            "aligning trajectories needs at least three pairs of poses",
            got=f"{len(estimate)} estimated, {len(truth)} true",
        )
    x, y = estimate[..., 3].double(), truth[..., 3].double()
    from_x, from_y = x - x.mean(0), y - y.mean(0)
    u, singular, vt = torch.linalg.svd(from_y.T @ from_x / len(x))
    flip = torch.ones(3, dtype=torch.float64)
    flip[2] = torch.linalg.det(u @ vt).sign()
    rotation = u @ torch.diag(flip) @ vt
    scale = float((singular * flip).sum() / from_x.square().sum(-1).mean())
    translation = y.mean(0) - scale * rotation @ x.mean(0)
    return Alignment(scale, rotation.to(truth), translation.to(truth))


def absolute_error(estimate: Float[Tensor, "n 3 4"], truth: Float[Tensor, "n 3 4"]) -> PoseError:
    """Absolute trajectory error: how far each pose is off after the best similarity."""
    return _error(align(estimate, truth)(estimate), truth)


def relative_error(
    estimate: Float[Tensor, "n 3 4"], truth: Float[Tensor, "n 3 4"], *, stride: int = 1
) -> PoseError:
    """Relative pose error: how far the motion over `stride` poses is off, after aligning."""
    aligned = align(estimate, truth)(estimate)
    return _error(_motion(aligned, stride), _motion(truth, stride))


def _motion(poses: Float[Tensor, "n 3 4"], stride: int) -> Float[Tensor, "m 3 4"]:
    return compose(inverse(poses[:-stride]), poses[stride:])


def _error(estimate: Float[Tensor, "n 3 4"], truth: Float[Tensor, "n 3 4"]) -> PoseError:
    off = compose(inverse(truth), estimate).double()
    cosine = (off.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    # The skew part gives the sine; atan2 stays exact for small angles, where acos does not.
    skew = off[..., :3] - off[..., :3].mT
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1).norm(dim=-1) / 2
    angle = torch.atan2(sine, cosine)
    return PoseError(
        translation=float(off[..., 3].square().sum(-1).mean().sqrt()),
        rotation_deg=float(torch.rad2deg(angle.square().mean().sqrt())),
    )
