"""Camera trajectories in files of their own, of several programs.

- `tum`: a text with a line `t x y z qx qy qz qw` per pose; t in seconds, position and rotation
  (a quaternion) world-from-camera; lines that begin with # are ignored.
- `npz`: the `trajectory.npz` of a capture, with arrays `times_us` and `poses`; of several moving
  tracks (`0_times_us`, ...), the first.
- `euroc`: CSV of `timestamp [ns], x, y, z, qw, qx, qy, qz`, and further columns that are ignored;
  the first line begins with #.
- `kitti`: a line of twelve numbers, a `[3 4]` matrix, per pose. Times are in `times.txt` (s)
  beside it or one folder up; without it there must be a pose for each frame.
- `csv`: logs of motor encoders and motion stages. The first line names the columns: a time `t_s`,
  `t_ms`, `t_us` or `t_ns`; positions `x_m`, `y_mm`, ...; rotations `rx_deg`, `ry_rad`, ... about
  the axes, or a quaternion `qx, qy, qz, qw`. Missing columns are zero. Rotations about several
  axes are applied in the order x, y, z, about fixed axes.
- `colmap`: a folder with a model; poses belong to images by name and have no times.

Axes are OpenCV's, and times are on the clock of the capture that the trajectory is used with.

Sources: Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems* (IROS 2012); Burri et
al., *The EuRoC micro aerial vehicle datasets* (IJRR 2016); Geiger et al., *Are we ready for
autonomous driving?* (CVPR 2012).
"""

import csv
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.captures.layouts.colmap import Model, find_model, read_model
from sharpfield.core.errors import CaptureError, OptionError
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
    expected = (
        "a text with a line `t x y z qx qy qz qw` per pose (t in seconds), or the"
        " trajectory.npz of a capture"
    )
    rows = _numbers(path, None, expected)
    if rows.shape[1] != TUM_COLUMNS:
        raise _malformed(path, f"{rows.shape[1]} columns", expected)
    poses = poses_of_quaternions(rows[:, 1:], path, do="the columns are t x y z qx qy qz qw")
    return np.rint(rows[:, 0] * 1e6).astype(np.int64), poses


PathLayout = Literal["tum", "euroc", "kitti", "csv", "npz", "colmap"]

PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
KITTI_COLUMNS, EUROC_COLUMNS, POSE_COLUMNS = 12, 8, 7
NANOSECONDS = 1000


@dataclass(frozen=True)
class ExternalPath:
    """Poses from a file of another program."""

    layout: PathLayout
    poses: Float64[np.ndarray, "p 3 4"]
    """World-from-body; the body is the camera unless there is a hand-eye transform."""
    times_us: Int64[np.ndarray, "p"] | None = None
    """On the clock of the file."""
    names: tuple[str, ...] | None = None
    """Of the images, without suffix, where poses belong to images."""
    model: Model | None = None
    """The reconstruction, if the poses are part of one."""


def read_path(path: Path, layout: PathLayout | None = None) -> ExternalPath:
    """Read a trajectory in any of the layouts.

    Args:
        path: The file, or the folder of a COLMAP model.
        layout: By default it is recognised.

    Raises:
        CaptureError: It is missing or malformed, or its layout is ambiguous.
    """
    if not path.exists():
        raise CaptureError("trajectory not found", where=path, do="check the path")
    kind = layout or path_layout(path)
    if kind == "colmap":
        return _colmap(path)
    if kind in ("tum", "npz"):
        times_us, poses = read_poses(path)
        return ExternalPath(kind, poses, times_us)
    found = {"euroc": _euroc, "kitti": _kitti, "csv": _motion_log}[kind](path)
    check_poses(found.poses, path)
    return found


def path_layout(path: Path) -> PathLayout:
    """The layout of a trajectory file, by its name and its first lines.

    Raises:
        CaptureError: No layout fits.
    """
    if path.is_dir():
        return "colmap"
    if path.suffix == ".npz":
        return "npz"
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = [line.strip() for line, _ in zip(file, range(50), strict=False)]
    rows = [line for line in lines if line and not line.startswith("#")]
    first = rows[0] if rows else ""
    if "," in first:
        if any(cell.strip()[:1].isalpha() for cell in first.split(",")):
            return "csv"
        if len(first.split(",")) >= EUROC_COLUMNS:
            return "euroc"
    elif len(first.split()) == TUM_COLUMNS:
        return "tum"
    elif len(first.split()) == KITTI_COLUMNS:
        return "kitti"
    raise CaptureError(
        "unknown layout of a trajectory",
        where=path,
        got=first[:80] or "an empty file",
        do="give --layout tum (8 columns), euroc, kitti (12 columns) or csv (named columns)",
    )


def read_hand_eye(path: Path) -> Float64[np.ndarray, "3 4"]:
    """Read the pose of the camera on the tracked body: body-from-camera.

    The file is a text of a `[3 4]` or `[4 4]` matrix, or of one line `x y z qx qy qz qw`.

    Raises:
        CaptureError: It is missing or malformed.
    """
    if not path.is_file():
        raise CaptureError("hand-eye file not found", where=path, do="check the path")
    rows = _numbers(path, None)
    if rows.size == POSE_COLUMNS:
        pose = poses_of_quaternions(rows.reshape(1, POSE_COLUMNS), path)
    elif rows.shape in ((3, 4), (4, 4)):
        pose = rows[None, :3]
    else:
        raise CaptureError(
            "not a pose",
            where=path,
            got=f"{rows.shape[0]} lines of {rows.shape[1]} numbers",
            do="write a 3x4 or 4x4 matrix, or one line `x y z qx qy qz qw`: body from camera",
        )
    check_poses(pose, path)
    return pose[0]


def _colmap(path: Path) -> ExternalPath:
    folder = find_model(path)
    if folder is None:
        raise CaptureError("no COLMAP model", where=path, do="give the folder of images.bin")
    model = read_model(folder)
    names = tuple(Path(name).with_suffix("").as_posix() for name in model.names)
    return ExternalPath("colmap", model.poses, names=names, model=model)


def _euroc(path: Path) -> ExternalPath:
    rows = _numbers(path, ",")
    if rows.shape[1] < EUROC_COLUMNS:
        raise _malformed(path, f"{rows.shape[1]} columns", "t [ns], x, y, z, qw, qx, qy, qz")
    poses = poses_of_quaternions(rows[:, [1, 2, 3, 5, 6, 7, 4]], path)
    with path.open(encoding="utf-8", errors="replace") as file:  # float64 cannot hold ns since 1970
        times = [line.split(",")[0] for line in file if line.strip() and line.strip()[0] != "#"]
    return ExternalPath(
        "euroc",
        poses,
        np.array([int(float(t)) if "." in t else int(t) for t in times]) // NANOSECONDS,
    )


def _kitti(path: Path) -> ExternalPath:
    rows = _numbers(path, None)
    if rows.shape[1] != KITTI_COLUMNS:
        raise _malformed(path, f"{rows.shape[1]} columns", "twelve numbers per pose, row by row")
    poses = _orthonormal(rows.reshape(-1, 3, 4))
    candidates = [folder / "times.txt" for folder in (path.parent, path.parent.parent)]
    times_file = next((file for file in candidates if file.is_file()), None)
    if times_file is None:
        return ExternalPath("kitti", poses)
    seconds = _numbers(times_file, None)[:, 0]
    if len(seconds) != len(poses):
        raise CaptureError(
            "there must be one time for each pose",
            where=times_file,
            got=f"{len(seconds)} times, {len(poses)} poses",
            do="give the times.txt of this trajectory",
        )
    return ExternalPath("kitti", poses, np.rint(seconds * 1e6).astype(np.int64))


def _motion_log(path: Path) -> ExternalPath:
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        rows = [row for row in csv.reader(file) if row and not row[0].lstrip().startswith("#")]
    names = [name.strip().lower() for name in rows[0]] if rows else []
    try:
        table = np.array([[float(cell) for cell in row] for row in rows[1:]], np.float64)
    except ValueError as error:
        raise _malformed(path, error, "numbers below the names of the columns") from None
    if not len(table) or table.ndim != 2 or table.shape[1] != len(names):
        raise _malformed(
            path, f"{len(rows)} lines", "a line of names, then as many numbers in each"
        )
    columns = dict(zip(names, table.T, strict=True))
    times = [
        (name, unit) for name in names if name[:2] == "t_" and (unit := name[2:]) in PER_SECOND
    ]
    if len(times) != 1:
        raise OptionError(
            "a log of motion must have one column of times with their unit",
            where=path,
            got=", ".join(names),
            do="name one column t_s, t_ms, t_us or t_ns",
        )
    time, unit = times[0]
    times_us = np.rint(columns[time] * (PER_SECOND["us"] / PER_SECOND[unit])).astype(np.int64)
    position = np.stack([_column_in_base_unit(columns, axis, LENGTHS) for axis in "xyz"], -1)
    if {"qx", "qy", "qz", "qw"} <= columns.keys():
        quaternion = np.stack([columns[q] for q in ("qx", "qy", "qz", "qw")], -1)
        return ExternalPath(
            "csv", poses_of_quaternions(np.concatenate([position, quaternion], -1), path), times_us
        )
    rotation = np.broadcast_to(np.eye(3), (len(table), 3, 3))
    for i, axis in enumerate("xyz"):
        vector = np.zeros((len(table), 3))
        vector[:, i] = _column_in_base_unit(columns, f"r{axis}", ANGLES)
        rotation = se3.rotation_exp(torch.from_numpy(vector)).numpy() @ rotation
    return ExternalPath("csv", np.concatenate([rotation, position[..., None]], -1), times_us)


def _column_in_base_unit(
    columns: dict[str, np.ndarray], axis: str, units: dict[str, float]
) -> Float64[np.ndarray, "p"]:
    """The column of an axis in its base unit; zeros if there is none."""
    for unit, factor in units.items():
        if f"{axis}_{unit}" in columns:
            return columns[f"{axis}_{unit}"] * factor
    return np.zeros(len(next(iter(columns.values()))))


def _orthonormal(poses: Float64[np.ndarray, "p 3 4"]) -> Float64[np.ndarray, "p 3 4"]:
    """Poses with the nearest rotations, as files round to six digits; others stay to be refused."""
    u, singular, vt = np.linalg.svd(poses[:, :, :3])
    near = (np.abs(singular - 1).max(-1) < UNIT_LENGTH)[:, None, None]
    rotation = np.where(near, u @ vt, poses[:, :, :3])
    return np.concatenate([rotation, poses[:, :, 3:]], -1)


def _numbers(
    path: Path, delimiter: str | None, expected: str = "lines of numbers, all of one length"
) -> Float64[np.ndarray, "n m"]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is refused below
            rows = np.loadtxt(path, delimiter=delimiter, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise _malformed(path, error, expected) from None
    if not rows.size:
        raise _malformed(path, "no numbers", expected)
    return rows


def _malformed(path: Path, got: object, expected: str) -> CaptureError:
    return CaptureError(
        "cannot read the trajectory", where=path, got=got, do=f"expected {expected}"
    )
