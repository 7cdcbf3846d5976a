"""NeRF-synthetic scenes: objects rendered by Blender from around, with an alpha channel.

    transforms_train.json     `camera_angle_x` (rad) and frames; _val and _test likewise
    train/r_0.png, ...        RGBA

Source: Mildenhall et al., *NeRF* (ECCV 2020), and its data loader: laid on white, depths 2 to 6.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.captures.hold_out import split_by_rule
from sharpfield.captures.layout import NO_OPTIONS, Layout, Missing, ReadOptions
from sharpfield.captures.layouts._photos import HOLD_OUT, Photos, existing, photo_capture
from sharpfield.captures.layouts._transforms import (
    frame_name,
    frames_of,
    image_path,
    number,
    poses_of,
    read_json,
)
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Known, Split
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import read_images

BOUNDS = (2.0, 6.0)
"""Nearest and farthest depth of these scenes."""

SETS = ("train", "test", "val")


def recognise(folder: Path) -> bool:
    """Whether a folder looks like such a scene."""
    return (folder / "transforms_train.json").is_file()


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene, composited on white.

    The test set is held out, or where there is none the validation set, or where there is
    neither every 8th training image.

    Args:
        folder: Holds what the module describes.
        options: `missing` images; `hold_out`, where there is a training set only.

    Raises:
        CaptureError: Something is missing, malformed, or does not fit together.
    """
    sets = {
        name: _frames(folder / f"transforms_{name}.json", options.missing) for name in _sets(folder)
    }
    frames = [frame for members in sets.values() for frame in members]
    paths = [image_path(folder, frame["file_path"]) for frame in frames]
    images = read_images(paths, alpha="white")
    angles = {round(frame["camera_angle_x"], 6) for frame in frames}
    if len(angles) != 1:
        raise CaptureError(
            "the sets of a scene must share one camera",
            where=folder,
            got=f"camera_angle_x {sorted(angles)}",
        )
    height, width = images.shape[1:3]
    focal = 0.5 * width / math.tan(0.5 * frames[0]["camera_angle_x"])
    photos = Photos(
        images=images,
        poses=poses_of(frames, folder),
        names=[frame_name(frame["file_path"]) for frame in frames],
        camera=Camera(width, height, focal, focal, width / 2, height / 2),
    )
    return photo_capture(
        photos,
        _split([len(members) for members in sets.values()], options.hold_out or HOLD_OUT),
        bounds=BOUNDS,
        name=folder.resolve().name,
        source="nerf-synthetic",
        known=Known(background="white"),
    )


def _sets(folder: Path) -> list[str]:
    """The training set, and the first of the others that is there."""
    there = [name for name in SETS if (folder / f"transforms_{name}.json").is_file()]
    if "train" not in there:
        raise CaptureError("there is no transforms_train.json", where=folder)
    return there[:2]


def _frames(path: Path, missing: Missing | None) -> list[dict[str, Any]]:
    """Frames whose image is there; the field of view, which all share, is put in each."""
    content = read_json(path)
    angle = number(content, "camera_angle_x", path)
    if not 0 < angle < math.pi:
        raise CaptureError("`camera_angle_x` must lie between 0 and pi rad", where=path, got=angle)
    frames = frames_of(content, path)
    paths = [image_path(path.parent, frame["file_path"]) for frame in frames]
    kept = existing(paths, missing=missing, where=path)
    return [{**frames[i], "camera_angle_x": angle} for i in kept]


def _split(counts: list[int], hold_out: str) -> Split:
    if len(counts) == 1:
        return split_by_rule(counts[0], hold_out)
    train, test = counts
    return Split(
        train=np.arange(train, dtype=np.int64),
        test=np.arange(train, train + test, dtype=np.int64),
    )


LAYOUT = Layout("nerf-synthetic", recognise, read, "transforms_train.json", options=("missing",))
