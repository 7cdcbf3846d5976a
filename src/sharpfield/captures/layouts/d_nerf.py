"""D-NeRF's scenes: moving objects rendered by Blender, each instant from another viewpoint.

    transforms_train.json     `camera_angle_x` (rad) and frames with `time`; _val and _test likewise
    train/r_000.png, ...      RGBA

Every frame is a still track of its own, and an instant. The recording is defined to last one
second.

Source: Pumarola et al., *D-NeRF* (CVPR 2021), and its data loader: composited on white, depths 2
to 6.
"""

from pathlib import Path

import numpy as np

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._transforms import (
    BLENDER_BOUNDS,
    ONE_SECOND,
    has_times,
    images_of,
    train_and_held_out,
)
from sharpfield.core.capture import Capture, Known, Split
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry.trajectory import Still


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return has_times(folder / "transforms_train.json")


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene, composited on white. The test set is held out, or else the validation set.

    Args:
        folder: Holds what the module describes.
        options: `missing` images.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    sets = train_and_held_out(folder, options.missing)
    images = images_of(sets, alpha="white")
    assert images is not None, "at least one image of each set exists"
    t_us = np.concatenate([one.t_us for one in sets])
    frame, train = np.arange(len(t_us)), len(sets[0])
    return Capture(
        camera=sets[0].camera(images.shape[2], images.shape[1]),
        trajectory=Still(np.concatenate([one.poses for one in sets])),
        clock=ONE_SECOND,
        near=BLENDER_BOUNDS[0],
        far=BLENDER_BOUNDS[1],
        frames=Frames(
            images=images,
            exposure=Exposure(t_us, t_us),
            track=frame,
            names=tuple(name for one in sets for name in one.names),
            encoding="srgb",
        ),
        split=Split(frame[:train], frame[train:]),
        name=folder.resolve().name,
        source="d-nerf",
        known=Known(background="white"),
        notes={"clock": "defined to last one second"},
    )


LAYOUT = Layout(
    "d-nerf",
    recognise,
    read,
    "transforms_train.json with a `time` in each frame",
    options=("missing",),
)
