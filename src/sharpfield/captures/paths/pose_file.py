"""A camera trajectory in a file of its own, apart from any capture.

- TUM: a text with a line `t x y z qx qy qz qw` per pose; t in seconds, position and rotation
  (a quaternion) world-from-camera; lines that begin with # are ignored.
- Ours: the `trajectory.npz` of a capture, with arrays `times_us` and `poses`; of several moving
  tracks (`0_times_us`, ...), the first.

Axes are OpenCV's, and times are on the clock of the capture that the trajectory is used with.

Source: Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems* (IROS 2012).
"""

import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.errors import CaptureError
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import check_poses
from sharpfield.storage.arrays import load_arrays

Path3 = tuple[Int64[np.ndarray, "p"], Float64[np.ndarray, "p 3 4"]]
"""Times in us, and world-from-camera poses."""

TUM_COLUMNS = 8

UNIT_LENGTH = 1e-2
"""Tolerance of the length of a quaternion; files round to four digits or more."""


def read_poses(path: Path) -> Path3:
    """Read times in us and world-from-camera poses from a file.

    Raises:
        CaptureError: The file is missing or malformed, or holds no trajectory.
    """
    if not path.is_file():
        raise CaptureError("trajectory file not found", where=path, do="check the path")
    times_us, poses = _native(path) if path.suffix == ".npz" else _tum(path)
    check_poses(poses, path)
    return times_us, poses


def poses_of_quaternions(
    rows: Float64[np.ndarray, "p 7"], where: object, *, do: str = "check the order of the columns"
) -> Float64[np.ndarray, "p 3 4"]:
    """Poses `[R | t]` from rows `x y z qx qy qz qw`.

    Raises:
        CaptureError: A quaternion does not have length one; `do` states the order of columns.
    """
    length = np.linalg.norm(rows[:, 3:], axis=1)
    wrong = np.flatnonzero(~(np.abs(length - 1) < UNIT_LENGTH))
    if len(wrong):
        raise CaptureError(
            "a quaternion must have length one",
            where=f"{where}, pose {wrong[0]}",
            got=f"length {length[wrong[0]]:.4g}",
            do=do,
        )
    wxyz = torch.from_numpy(rows[:, [6, 3, 4, 5]] / length[:, None])
    return np.concatenate([se3.rotation_from_quaternion(wxyz).numpy(), rows[:, :3, None]], -1)


def _native(path: Path) -> Path3:
    arrays = load_arrays(path)
    for prefix in ("", "0_"):
        if {prefix + "times_us", prefix + "poses"} <= arrays.keys():
            times_us, poses = arrays[prefix + "times_us"], arrays[prefix + "poses"]
            return times_us.astype(np.int64), poses.astype(np.float64)
    raise CaptureError(
        "this file holds no trajectory with times",
        where=path,
        got=", ".join(arrays) or "no arrays",
        do="it needs the arrays `times_us` and `poses`; static cameras have no trajectory",
    )


def _tum(path: Path) -> Path3:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is refused below
            rows = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise _not_tum(path, error) from None
    if not rows.size or rows.shape[1] != TUM_COLUMNS:
        raise _not_tum(path, f"{rows.shape[1]} columns" if rows.size else "no poses")
    poses = poses_of_quaternions(rows[:, 1:], path, do="the columns are t x y z qx qy qz qw")
    return np.rint(rows[:, 0] * 1e6).astype(np.int64), poses


def _not_tum(path: Path, got: object) -> CaptureError:
    return CaptureError(
        "cannot read the trajectory",
        where=path,
        got=got,
        do="write a text with a line `t x y z qx qy qz qw` per pose (t in seconds), or give the"
        " trajectory.npz of a capture",
    )
