"""D-NeRF's scenes: objects that move, rendered by Blender, each instant from another place.

    transforms_train.json     `camera_angle_x` (rad) and frames with `time`; _val and _test likewise
    train/r_000.png, ...      RGBA

Every frame is a still track of its own, and an instant. The recording is said to last one second.

Source: Pumarola et al., *D-NeRF* (CVPR 2021), and its data loader: laid on white, depths 2 to 6.
"""

from pathlib import Path

import numpy as np

from sharpfield.captures.layout import NO_OPTIONS, Layout, Missing, ReadOptions
from sharpfield.captures.layouts._photos import existing
from sharpfield.captures.layouts._transforms import (
    ONE_SECOND,
    TimedViews,
    expect_one_camera,
    has_times,
    images_of,
    read_views,
)
from sharpfield.core.capture import Capture, Known, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry.trajectory import Still

BOUNDS = (2.0, 6.0)
"""Nearest and farthest depth of these scenes."""


def recognise(folder: Path) -> bool:
    """Whether a folder looks like such a scene."""
    return has_times(folder / "transforms_train.json")


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene, composited on white. The test set is held out, or else the validation set.

    Args:
        folder: Holds what the module describes.
        options: `missing` images.

    Raises:
        CaptureError: Something is missing, malformed, or does not fit together.
    """
    sets = [
        _kept(read_views(folder / f"transforms_{name}.json"), options.missing)
        for name in _sets(folder)
    ]
    expect_one_camera(sets, folder)
    images = images_of(sets, alpha="white")
    assert images is not None, "at least one image of each set is there"
    t_us = np.concatenate([one.t_us for one in sets])
    count, train = len(t_us), len(sets[0])
    every = np.arange(count)
    return Capture(
        camera=sets[0].camera(images.shape[2], images.shape[1]),
        trajectory=Still(np.concatenate([one.poses for one in sets])),
        clock=ONE_SECOND,
        near=BOUNDS[0],
        far=BOUNDS[1],
        frames=Frames(
            images=images,
            exposure=Exposure(t_us, t_us),
            track=every,
            names=tuple(name for one in sets for name in one.names),
            encoding="srgb",
        ),
        split=Split(every[:train], every[train:]),
        name=folder.resolve().name,
        source="d-nerf",
        known=Known(background="white"),
        notes={"clock": "said to last one second"},
    )


def _sets(folder: Path) -> list[str]:
    """The training set, and the first of the others that is there."""
    there = [
        name for name in ("train", "test", "val") if (folder / f"transforms_{name}.json").is_file()
    ]
    if "train" not in there:
        raise CaptureError("there is no transforms_train.json", where=folder)
    return there[:2]


def _kept(views: TimedViews, missing: Missing | None) -> TimedViews:
    """The frames whose image is there."""
    kept = existing(views.paths, missing=missing, where=views.paths[0].parent)
    return TimedViews(
        names=tuple(views.names[i] for i in kept),
        paths=tuple(views.paths[i] for i in kept),
        time=views.time[kept],
        poses=views.poses[kept],
        angle_rad=views.angle_rad,
        focal_px=views.focal_px,
    )


LAYOUT = Layout(
    "d-nerf",
    recognise,
    read,
    "transforms_train.json with a `time` in each frame",
    options=("missing",),
)
