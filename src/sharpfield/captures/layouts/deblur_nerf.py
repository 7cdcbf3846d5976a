"""Deblur-NeRF and LLFF scenes: photos, some blurred and some sharp, with a pose table.

    images/ or images_N/    photos, sorted by name; images_N are N times smaller
    poses_bounds.npy        one row per photo
    hold=K                  optional marker: every K-th photo is held out (sharp in Deblur-NeRF)
    sparse/0/               optional COLMAP model from which the poses came

Source: Ma et al., *Deblur-NeRF* (CVPR 2022) and its released scenes; Mildenhall et al., *Local
Light Field Fusion* (SIGGRAPH 2019).
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sharpfield.captures.hold_out import split_by_rule
from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import HOLD_OUT, Photos, choose_images, photo_capture
from sharpfield.captures.layouts._poses_bounds import PosesBounds, read_poses_bounds
from sharpfield.captures.layouts.colmap_model import find_model, read_model
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import list_images, read_images

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
