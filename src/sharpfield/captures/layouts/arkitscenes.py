"""ARKitScenes: recordings of an iPad with a lidar.

    lowres_wide/VIDEO_TIME.png                  RGB, 256x192; TIME in seconds
    lowres_depth/VIDEO_TIME.png                 16 bit, millimetres, registered
    lowres_wide_intrinsics/VIDEO_TIME.pincam    `width height fx fy cx cy` of each frame
    lowres_wide.traj                            `time rx ry rz tx ty tz` in s, rad, m

The times in the three names may differ by a millisecond, and depth may have been recorded less
often: an image has the depth map of the same time, or none. A line of the trajectory is
camera-from-world: rotation vector, then translation. It has ten poses a second and images sixty, so
poses are interpolated, and images before the first or after the last pose are left out. The lens
refocuses; a capture has one camera, so its intrinsics are the median of all, and
`notes["focal_spread"]` is the relative spread of the focal length.

Source: Baruch et al., *ARKitScenes* (NeurIPS 2021 datasets track), its data description.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._rgbd import RgbdFrames, read_matrix, read_rgb, rgbd_capture
from sharpfield.captures.native.frames import decode_depth
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock
from sharpfield.core.errors import CaptureError
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped

WIDE, DEPTH, INTRINSICS = "lowres_wide", "lowres_depth", "lowres_wide_intrinsics"
TRAJECTORY = "lowres_wide.traj"
COLUMNS = 7
SAME_S = 0.005
"""Depth maps closer in time to an image belong to it, in seconds."""


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / WIDE).is_dir() and (folder / TRAJECTORY).is_file()


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a recording.

    Args:
        folder: Holds what the module describes.
        options: `hold_out`.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    colour = sorted((folder / WIDE).glob("*.png"), key=_seconds)
    if not colour:
        raise CaptureError(
            f"there are no images in {WIDE}/", where=folder, do="it must hold VIDEO_TIME.png"
        )
    camera, spread = _camera(folder)
    maps, measured = _depth_of(colour, list((folder / DEPTH).glob("*.png")))
    if not measured.any():
        raise CaptureError(
            f"no image of {WIDE}/ has depth in {DEPTH}/",
            where=folder,
            do="names must end in the same time",
        )
    frames = RgbdFrames(
        names=[path.stem for path in colour],
        poses=_poses(folder / TRAJECTORY, [_seconds(path) for path in colour]),
        colour=lambda row: read_rgb(colour[row]),
        depth=lambda row: decode_depth(maps[row]),
        measured=measured,
        camera=camera,
        depth_camera=camera,
        sources=colour,
        depth_sources=[path for path, known in zip(maps, measured, strict=True) if known],
    )
    made = rgbd_capture(frames, options.hold_out, folder=folder, source="arkitscenes")
    return replace(made, notes=made.notes | {"focal_spread": spread})


def _seconds(path: Path) -> float:
    digits = path.stem.rpartition("_")[2]
    try:
        return float(digits)
    except ValueError:
        raise CaptureError(
            "the name of an image must end in its time", where=path, do="name it VIDEO_TIME.png"
        ) from None


def _depth_of(
    colour: Sequence[Path], depth: Sequence[Path]
) -> tuple[list[Path], Bool[np.ndarray, "n"]]:
    """The depth map nearest in time to each image, and whether its time is the same."""
    if not depth:
        return list(colour), np.zeros(len(colour), bool)
    ordered = sorted(depth, key=_seconds)
    times, asked = (np.array([_seconds(path) for path in paths]) for paths in (ordered, colour))
    after = np.searchsorted(times, asked).clip(1, max(len(times) - 1, 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(times[after] - asked < asked - times[before], after, before)
    return [ordered[i] for i in nearest], np.abs(times[nearest] - asked) < SAME_S


def _camera(folder: Path) -> tuple[Camera, float]:
    """The median camera of all frames, and the relative spread of the focal length."""
    rows = []
    for path in sorted((folder / INTRINSICS).glob("*.pincam")):
        rows.append(read_matrix(path).ravel())
        if len(rows[-1]) != 6:
            raise CaptureError(
                "intrinsics must be six numbers",
                where=path,
                got=len(rows[-1]),
                do="write width height fx fy cx cy",
            )
    table = np.stack(rows or [np.zeros(6)])
    if not table[:, 2].all():
        raise CaptureError(
            "no image has intrinsics", where=folder / INTRINSICS, do="add the .pincam files"
        )
    width, height, fx, fy, cx, cy = np.median(table, axis=0).tolist()
    return Camera(int(width), int(height), fx, fy, cx, cy), float(np.ptp(table[:, 2]) / fx)


def _poses(path: Path, times_s: Sequence[float]) -> Float64[np.ndarray, "n 3 4"]:
    """Poses at the times of images; NaN outside of the trajectory."""
    rows = read_matrix(path)
    if rows.shape[1] != COLUMNS or len(rows) < 2:
        raise CaptureError(
            "a trajectory must have at least two lines of seven numbers",
            where=path,
            got=rows.shape,
            do="write time rx ry rz tx ty tz per line",
        )
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    rotation = se3.rotation_exp(torch.from_numpy(rows[:, 1:4])).numpy()  # camera from world
    inverse = rotation.transpose(0, 2, 1)
    poses = np.concatenate([inverse, -inverse @ rows[:, 4:, None]], -1)  # [p, 3, 4]
    known_us = np.rint(1e6 * (rows[:, 0] - rows[0, 0])).astype(np.int64)
    distinct = np.flatnonzero(np.diff(known_us, prepend=-1) > 0)
    clock = Clock(0, max(int(known_us[-1]), 1))
    trajectory = Stamped(known_us[distinct], np.ascontiguousarray(poses[distinct]), clock, "linear")
    asked = np.rint(1e6 * (np.asarray(times_s) - rows[0, 0])).astype(np.int64)
    inside = (asked >= 0) & (asked <= known_us[-1])
    found = np.full((len(asked), 3, 4), np.nan)
    unit = torch.from_numpy(clock.unit(asked[inside]))
    found[inside] = (
        trajectory.pose(unit, torch.zeros(len(unit), dtype=torch.int64)).double().numpy()
    )
    return found


LAYOUT = Layout("arkitscenes", recognise, read, "lowres_wide/ and lowres_wide.traj")
