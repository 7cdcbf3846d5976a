"""`poses_bounds.npy`: the pose table of LLFF, also of Deblur-NeRF and Ev-DeblurNeRF scenes.

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
from sharpfield.geometry.trajectory import check_poses
from sharpfield.storage.arrays import load_array


@dataclass(frozen=True)
class PosesBounds:
    """Poses, one image size and focal length, and depth bounds."""

    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes."""
    width: float
    height: float
    focal_px: float
    """For images of `width` x `height`, which may differ from the size of the images at hand."""
    bounds: Float64[np.ndarray, "n 2"]
    """Nearest and farthest depth seen by each camera."""

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.poses)


def read_poses_bounds(path: Path) -> PosesBounds:
    """Read and check a pose table.

    Raises:
        CaptureError: The file is missing or malformed, or holds non-finite numbers, invalid
            rotations, different cameras, or impossible depth bounds.
    """
    rows = load_array(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise CaptureError(
            "a pose table must have 17 columns",
            where=path,
            got=f"shape {rows.shape}",
            do="write the table of LLFF's imgs2poses: 3x5 matrix, near, far",
        )
    rows = rows.astype(np.float64)
    matrix = rows[:, :15].reshape(-1, 3, 5)  # [n, 3, 5]
    down, right, backward, centre, intrinsics = np.moveaxis(matrix, -1, 0)
    poses = np.stack([right, down, -backward, centre], -1)  # [n, 3, 4]
    check_poses(poses, path)
    if np.ptp(intrinsics, 0).max() > 1e-3 * np.abs(intrinsics).max():
        raise CaptureError(
            "the cameras of a scene must have one size and focal length",
            where=f"{path}, columns 5, 10 and 15",
            got=f"focal lengths from {intrinsics[:, 2].min():g} to {intrinsics[:, 2].max():g}",
            do="use the images of one camera",
        )
    bounds = rows[:, 15:]
    wrong = np.flatnonzero((bounds[:, 0] <= 0) | (bounds[:, 1] <= bounds[:, 0]))
    if len(wrong):
        raise CaptureError(
            "depth bounds must satisfy 0 < near < far",
            where=f"{path}, row {wrong[0]}, last two columns",
            got=f"{bounds[wrong[0], 0]:g}, {bounds[wrong[0], 1]:g}",
            do="correct these two columns",
        )
    height, width, focal = intrinsics[0]
    return PosesBounds(poses, float(width), float(height), float(focal), bounds)
