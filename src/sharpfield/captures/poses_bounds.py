"""`poses_bounds.npy`: the pose table of LLFF, used by Deblur-NeRF and Ev-DeblurNeRF scenes.

Each row has 17 numbers: a 3x5 matrix in row-major order, `[R | t | (height, width, focal)]`, then
the nearest and farthest depth seen by that camera. The columns of R are the camera's down, right
and backward axes in the world; here they become OpenCV's right, down, forward.

Source: Mildenhall et al., *Local Light Field Fusion* (SIGGRAPH 2019), and its data loader.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sharpfield.core.errors import CaptureError

ORTHONORMAL = 1e-4
"""How far R^T R may be from the identity."""


@dataclass(frozen=True)
class PosesBounds:
    """Poses, one image size and focal length, and depth bounds."""

    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes."""
    width: float
    height: float
    focal_px: float
    """For images of `width` x `height`, which need not be the size of those at hand."""
    bounds: Float64[np.ndarray, "n 2"]
    """Nearest and farthest depth in view of each camera."""

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.poses)


def read_poses_bounds(path: Path) -> PosesBounds:
    """Read and check a pose table.

    Raises:
        CaptureError: The file is missing or malformed, holds non-finite numbers, a rotation that
            is not one, cameras that differ, or impossible depth bounds.
    """
    rows = _load(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise CaptureError(
            "a pose table must have 17 columns", where=path, got=f"shape {rows.shape}"
        )
    rows = rows.astype(np.float64)
    broken = np.flatnonzero(~np.isfinite(rows).all(1))
    if len(broken):
        raise CaptureError(
            "poses hold numbers that are not finite", where=f"{path}, row {broken[0]}"
        )
    matrix = rows[:, :15].reshape(-1, 3, 5)
    down, right, backward, centre, intrinsics = np.moveaxis(matrix, -1, 0)
    poses = np.stack([right, down, -backward, centre], -1)
    check_rotations(poses, path)
    if np.ptp(intrinsics, 0).max() > 1e-3 * np.abs(intrinsics).max():
        raise CaptureError(
            "the cameras of a scene must agree in size and focal length",
            where=f"{path}, columns 5, 10 and 15",
            got=f"focal lengths from {intrinsics[:, 2].min():g} to {intrinsics[:, 2].max():g}",
        )
    bounds = rows[:, 15:]
    wrong = np.flatnonzero((bounds[:, 0] <= 0) | (bounds[:, 1] <= bounds[:, 0]))
    if len(wrong):
        raise CaptureError(
            "depth bounds must satisfy 0 < near < far",
            where=f"{path}, row {wrong[0]}, last two columns",
            got=f"{bounds[wrong[0], 0]:g}, {bounds[wrong[0], 1]:g}",
        )
    height, width, focal = intrinsics[0]
    return PosesBounds(poses, float(width), float(height), float(focal), bounds)


def check_rotations(poses: Float64[np.ndarray, "n 3 4"], where: object) -> None:
    """Refuse poses whose left 3x3 part is not a rotation.

    Raises:
        CaptureError: One is not orthonormal or is a mirror image.
    """
    rotation = poses[:, :, :3]
    residual = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max((1, 2))
    wrong = np.flatnonzero(~(residual < ORTHONORMAL) | (np.linalg.det(rotation) < 0))
    if len(wrong):
        i = wrong[0]
        raise CaptureError(
            f"{len(wrong)} of {len(poses)} poses have no valid rotation",
            where=f"{where}, pose {i}",
            got=f"R^T R is off the identity by {residual[i]:.2g},"
            f" det R = {np.linalg.det(rotation[i]):.3f}",
            do="check the order and sign of the axes; remove any scale from the matrix",
        )


def _load(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise CaptureError("pose table not found", where=path) from None
    except (ValueError, EOFError, OSError) as error:
        raise CaptureError("cannot read pose table", where=path, got=error) from None
