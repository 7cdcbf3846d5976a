"""Blender scenes of NeRF (static) and D-NeRF (moving): objects with an alpha channel.

    transforms_train.json     `camera_angle_x` (rad) and frames; _val and _test likewise; in D-NeRF
                              each frame has a `time`
    train/r_0.png, ...        RGBA

In NeRF's scenes an object is seen from all sides, in D-NeRF's each instant from another viewpoint:
every frame is a still track of its own, and an instant. D-NeRF's recordings are defined to last one
second.

Source: Mildenhall et al., *NeRF* (ECCV 2020); Pumarola et al., *D-NeRF* (CVPR 2021); and their data
loaders: composited on white, depths 2 to 6.
"""

from pathlib import Path

import numpy as np

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import HOLD_OUT, Photos, photo_capture
from sharpfield.captures.layouts._transforms import (
    BLENDER_BOUNDS,
    ONE_SECOND,
    has_times,
    images_of,
    train_and_held_out,
)
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.capture import Capture, Known, Split


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "transforms_train.json").is_file()


def recognise_moving(folder: Path) -> bool:
    """Whether a folder has this layout, with times."""
    return has_times(folder / "transforms_train.json")


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a static scene, composited on white.

    The test set is held out, or where there is none the validation set, or where there is
    neither every 8th training image.

    Args:
        folder: Holds what the module describes.
        options: `missing` images; `hold_out`, where there is a training set only.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    return _read(folder, options, moving=False)


def read_moving(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a moving scene, composited on white, and hold out its test or else validation set.

    Args:
        folder: Holds what the module describes.
        options: `missing` images.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    return _read(folder, options, moving=True)


def _read(folder: Path, options: ReadOptions, *, moving: bool) -> Capture:
    sets = train_and_held_out(folder, options.missing, timed=moving)
    images = images_of(sets, alpha="white")
    assert images is not None, "at least one image of each set exists"
    photos = Photos(
        images=images,
        poses=np.concatenate([one.poses for one in sets]),
        names=[name for one in sets for name in one.names],
        camera=sets[0].camera(images.shape[2], images.shape[1]),
        taken=(np.concatenate([one.t_us for one in sets]), ONE_SECOND) if moving else None,
    )
    frame, train = np.arange(len(images)), len(sets[0])
    split = Split(frame[:train], frame[train:])
    if len(sets) == 1 and not moving:
        split = split_by_rule(train, options.hold_out or HOLD_OUT)
    return photo_capture(
        photos,
        split,
        bounds=BLENDER_BOUNDS,
        name=folder.resolve().name,
        source="d-nerf" if moving else "nerf-synthetic",
        known=Known(background="white"),
        notes={"clock": "defined to last one second"} if moving else None,
    )


NERF = Layout("nerf-synthetic", recognise, read, "transforms_train.json", options=("missing",))
D_NERF = Layout(
    "d-nerf",
    recognise_moving,
    read_moving,
    "transforms_train.json with a `time` in each frame",
    options=("missing",),
)
