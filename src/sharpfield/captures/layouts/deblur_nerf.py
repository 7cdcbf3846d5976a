"""Deblur-NeRF and LLFF scenes: photos, some blurred and some sharp, with a pose table.

    images/ or images_N/    photos, sorted by name; images_N are N times smaller
    poses_bounds.npy        one row per photo
    hold=K                  optional marker: every K-th photo is held out (sharp in Deblur-NeRF)
    sparse/0/               optional COLMAP model from which the poses came

The pose table is that of LLFF, also used by Ev-DeblurNeRF. Each row has 17 numbers: a 3x5 matrix in
row-major order, `[R | t | (height, width, focal)]`, then the nearest and farthest depth seen by
that camera. The columns of R are the camera's down, right and backward axes in the world; here they
become OpenCV's right, down, forward.

Source: Ma et al., *Deblur-NeRF* (CVPR 2022) and its released scenes; Mildenhall et al., *Local
Light Field Fusion* (SIGGRAPH 2019), and its data loader.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import HOLD_OUT, Photos, choose_images, photo_capture
from sharpfield.captures.layouts.colmap import find_model, read_model
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.geometry.trajectory import check_poses
from sharpfield.storage.arrays import load_array
from sharpfield.storage.images import list_images, read_images


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


SAME_POSITION = 0.01
"""Two reconstructions are the same if no camera position differs by more, relative to near."""


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout: a pose table and images, but no events."""
    return (
        (folder / "poses_bounds.npy").is_file()
        and any(folder.glob("images*/"))
        and not (folder / "events.h5").exists()
    )


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene.

    Args:
        folder: Holds what the module describes.
        options: `factor` of the images, by default the smallest there are, which is what the
            papers train on; `hold_out`, by default that of the marker file.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    images_folder = choose_images(folder, options.factor)
    table = read_poses_bounds(folder / "poses_bounds.npy")
    paths = list_images(images_folder)
    if len(paths) != len(table):
        raise CaptureError(
            "there must be one pose for each image",
            where=folder,
            got=f"{len(paths)} images in {images_folder.name}, {len(table)} poses",
            do="check for images that were added or removed afterwards",
        )
    width, height = round(table.width), round(table.height)
    photos = Photos(
        images=read_images(paths),
        poses=table.poses,
        names=[path.stem for path in paths],
        camera=Camera(
            width, height, table.focal_px, table.focal_px, cx_px=width / 2, cy_px=height / 2
        ),
        encoding="gamma2.2",
    )
    return photo_capture(
        photos,
        split_by_rule(len(paths), options.hold_out or _hold_out(folder)),
        bounds=(float(table.bounds.min()), float(table.bounds.max())),
        name=folder.resolve().name,
        source="deblur-nerf",
        points=_points(folder, table),
    )


def _hold_out(folder: Path) -> str:
    markers = [m for p in folder.glob("hold=*") if (m := re.fullmatch(r"hold=([1-9]\d*)", p.name))]
    if len(markers) > 1:
        raise CaptureError(
            "there must be at most one marker file hold=K",
            where=folder,
            got=", ".join(sorted(m[0] for m in markers)),
            do="delete all but one",
        )
    return f"every:{markers[0][1]}" if markers else HOLD_OUT


def _points(folder: Path, table: PosesBounds) -> Float64[np.ndarray, "m 3"] | None:
    """Points of the COLMAP model beside the table, if both describe the same reconstruction."""
    model_folder = find_model(folder)
    if model_folder is None:
        return None
    model = read_model(model_folder)
    if len(model.poses) != len(table):
        return None
    distance = np.linalg.norm(model.poses[:, :, 3] - table.poses[:, :, 3], axis=-1).max()
    return model.points if distance < SAME_POSITION * table.bounds.min() else None


LAYOUT = Layout(
    "deblur-nerf", recognise, read, "poses_bounds.npy and images*/", options=("factor",)
)
