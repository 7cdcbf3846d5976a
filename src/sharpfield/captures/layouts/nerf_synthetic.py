"""NeRF-synthetic scenes: objects rendered by Blender from all sides, with an alpha channel.

    transforms_train.json     `camera_angle_x` (rad) and frames; _val and _test likewise
    train/r_0.png, ...        RGBA

Source: Mildenhall et al., *NeRF* (ECCV 2020), and its data loader: composited on white, depths 2
to 6.
"""

from pathlib import Path

import numpy as np

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import HOLD_OUT, Photos, photo_capture
from sharpfield.captures.layouts._transforms import BLENDER_BOUNDS, images_of, train_and_held_out
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.capture import Capture, Known, Split


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "transforms_train.json").is_file()


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene, composited on white.

    The test set is held out, or where there is none the validation set, or where there is
    neither every 8th training image.

    Args:
        folder: Holds what the module describes.
        options: `missing` images; `hold_out`, where there is a training set only.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    sets = train_and_held_out(folder, options.missing, timed=False)
    images = images_of(sets, alpha="white")
    assert images is not None, "at least one image of each set exists"
    photos = Photos(
        images=images,
        poses=np.concatenate([one.poses for one in sets]),
        names=[name for one in sets for name in one.names],
        camera=sets[0].camera(images.shape[2], images.shape[1]),
    )
    frame, train = np.arange(len(images)), len(sets[0])
    split = Split(frame[:train], frame[train:])
    return photo_capture(
        photos,
        split_by_rule(train, options.hold_out or HOLD_OUT) if len(sets) == 1 else split,
        bounds=BLENDER_BOUNDS,
        name=folder.resolve().name,
        source="nerf-synthetic",
        known=Known(background="white"),
    )


LAYOUT = Layout("nerf-synthetic", recognise, read, "transforms_train.json", options=("missing",))
