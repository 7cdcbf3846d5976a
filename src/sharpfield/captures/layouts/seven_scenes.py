"""Sequences of a depth camera in the layout of 7-Scenes.

    frame-000000.color.png     RGB
    frame-000000.depth.png     16 bit, millimetres; 0 or 65535 where unknown
    frame-000000.pose.txt      4x4, world-from-camera

A folder is one sequence, or a scene with sequences in `seq-01/`, ...; then `TrainSplit.txt` and
`TestSplit.txt` list (`sequence1`) those for training and for testing. The files have no intrinsics:
both images have a focal length of 585 px and the principal point in the middle.

Source: Shotton et al., *Scene coordinate regression forests* (CVPR 2013), its data set.
"""

from pathlib import Path

import numpy as np
from jaxtyping import UInt16

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._rgbd import (
    RgbdFrames,
    read_pose,
    read_rgb,
    rgbd_capture,
    usable_poses,
)
from sharpfield.captures.native.frames import decode_depth
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError

FOCAL_OF_WIDTH = 585 / 640
UNKNOWN = 65535
COLOUR = "frame-*.color.png"
SPLITS = ("TrainSplit.txt", "TestSplit.txt")


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout: a sequence, or several."""
    return any(folder.glob(COLOUR)) or any(folder.glob(f"seq-*/{COLOUR}"))


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a sequence, or a scene of several.

    A scene is split by its lists of sequences; without them, one frame in five is for training.

    Args:
        folder: Holds what the module describes.
        options: `hold_out`, instead of the lists of sequences.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    colour = sorted(folder.glob(COLOUR)) or sorted(folder.glob(f"seq-*/{COLOUR}"))
    if not colour:
        raise CaptureError("there are no frames", where=folder, do=f"it must hold {COLOUR}")
    height, width, _ = read_rgb(colour[0]).shape
    focal = FOCAL_OF_WIDTH * width
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    poses = np.stack([read_pose(_beside(path, "pose.txt")) for path in colour])
    usable = [path for path, good in zip(colour, usable_poses(poses), strict=True) if good]
    several = colour[0].parent != folder
    maps = [_beside(path, "depth.png") for path in colour]
    frames = RgbdFrames(
        names=[f"{path.parent.name}_" * several + _number(path) for path in colour],
        poses=poses,
        colour=lambda row: read_rgb(colour[row]),
        depth=lambda row: _depth(maps[row]),
        measured=np.array([path.is_file() for path in maps]),
        camera=camera,
        depth_camera=camera,
        sources=colour,
        depth_sources=[path for path in maps if path.is_file()],
    )
    return rgbd_capture(
        frames, options.hold_out, folder=folder, source="7-scenes", split=_split(folder, usable)
    )


def _depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    steps = decode_depth(path)
    return np.where(steps == UNKNOWN, np.uint16(0), steps)


def _beside(colour: Path, ending: str) -> Path:
    return colour.with_name(colour.name.replace("color.png", ending))


def _number(path: Path) -> str:
    return path.name.split(".")[0].removeprefix("frame-")


def _split(folder: Path, paths: list[Path]) -> Split | None:
    """The split by the lists of a scene; None if there are none, or they match no sequence."""
    listed = [_sequences(folder / file) for file in SPLITS]
    if not all(listed):
        return None
    number = np.array([int("".join(filter(str.isdigit, path.parent.name)) or -1) for path in paths])
    train, test = (np.flatnonzero(np.isin(number, sorted(numbers))) for numbers in listed)
    return Split(train, test) if len(train) else None


def _sequences(path: Path) -> set[int]:
    if not path.is_file():
        return set()
    lines = path.read_text(errors="replace").split()
    return {int(digits) for line in lines if (digits := "".join(filter(str.isdigit, line)))}


LAYOUT = Layout("7-scenes", recognise, read, "frame-*.color.png")
