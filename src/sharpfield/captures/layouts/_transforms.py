"""`transforms*.json` of Blender scenes and nerfstudio: OpenGL poses, image paths, sets of views.

The columns of `transform_matrix` are the camera's right, up and backward axes and its centre in
the world; here the axes become OpenCV's right, down, forward.

A set of views is one file, `transforms_<set>.json`, with the horizontal field of view
`camera_angle_x` and, for a moving scene, a `time` of 0...1 in each frame. These files have no unit
of time: a recording is defined to last one second.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from sharpfield.captures.layout import Missing
from sharpfield.captures.layouts._photos import existing
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Clock
from sharpfield.core.errors import CaptureError
from sharpfield.geometry.trajectory import check_poses
from sharpfield.storage.images import SUFFIXES, Alpha, read_images

OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0, 1.0])

SECOND_US = 1_000_000
ONE_SECOND = Clock(0, SECOND_US)

SETS = ("train", "test", "val")
"""Sets of a scene; the first existing one after `train` is held out."""

BLENDER_BOUNDS = (2.0, 6.0)
"""Nearest and farthest depth of NeRF's and D-NeRF's Blender scenes."""


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        CaptureError: The file is missing or is not a JSON object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CaptureError("file not found", where=path, do="check the path") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError("not a JSON file", where=path, got=error, do="write it again") from None
    if not isinstance(content, dict):
        raise CaptureError(
            "must be a JSON object",
            where=path,
            got=type(content).__name__,
            do='write { "frames": [...], ... }',
        )
    return content


def frames_of(content: dict[str, Any], where: object) -> list[dict[str, Any]]:
    """The list of frames, each with `file_path` and `transform_matrix`.

    Raises:
        CaptureError: There are no frames, or a frame lacks one of these.
    """
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError("there are no frames", where=f"{where}, key `frames`", do="list them")
    for i, frame in enumerate(frames):
        for key, kind in (("file_path", str), ("transform_matrix", list)):
            if not isinstance(frame, dict) or not isinstance(frame.get(key), kind):
                raise CaptureError(
                    f"a frame lacks `{key}`", where=f"{where}, frame {i}", do="add it"
                )
    return frames


def poses_of(frames: Sequence[dict[str, Any]], where: object) -> Float64[np.ndarray, "n 3 4"]:
    """World-from-camera poses in OpenCV axes.

    Raises:
        CaptureError: A matrix is not 3x4 or 4x4, or holds no rotation.
    """
    try:
        matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64)
    except (ValueError, TypeError):
        matrices = np.zeros(0)
    if matrices.shape[1:] not in ((4, 4), (3, 4)):
        raise CaptureError(
            "each `transform_matrix` must be 4x4 or 3x4 numbers",
            where=where,
            do="write camera-to-world matrices",
        )
    poses = matrices[:, :3] * OPENCV_FROM_OPENGL  # [n, 3, 4]
    check_poses(poses, where)
    return poses


def image_path(folder: Path, file_path: str) -> Path:
    """The path of a frame's image; `file_path` may lack the suffix."""
    path = folder / file_path
    if path.suffix.lower() in SUFFIXES:
        return path
    candidates = [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    return next((candidate for candidate in candidates if candidate.is_file()), candidates[0])


def frame_name(file_path: str) -> str:
    """The name of a frame: its path without suffix, e.g. `train/r_0`."""
    path = Path(file_path)
    if path.suffix.lower() in SUFFIXES:
        path = path.with_suffix("")
    return path.as_posix()


def number(content: dict[str, Any], key: str, where: object) -> float:
    """A required number.

    Raises:
        CaptureError: It is missing or is not a number.
    """
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CaptureError(f"`{key}` must be a number", where=where, got=value, do="write a number")
    return float(value)


@dataclass(frozen=True)
class ViewSet:
    """The frames of one `transforms_<set>.json`."""

    names: tuple[str, ...]
    paths: tuple[Path, ...]
    """Of the images, whether or not they exist."""
    time: Float64[np.ndarray, "n"]
    """0...1; zeros for a static scene."""
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes."""
    angle_rad: float
    """Horizontal field of view."""
    focal_px: float
    """Focal length that the file states instead of the angle; 0 if it does not."""

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.names)

    @property
    def t_us(self) -> Int64[np.ndarray, "n"]:
        """Times in us; the recording lasts one second."""
        return np.rint(self.time * SECOND_US).astype(np.int64)

    def camera(self, width: int, height: int) -> Camera:
        """The camera of images of this size."""
        focal = self.focal_px or 0.5 * width / math.tan(0.5 * self.angle_rad)
        return Camera(width, height, focal, focal, width / 2, height / 2)

    def existing(self, missing: Missing | None, where: Path) -> "ViewSet":
        """The frames whose images exist; `where` is the file that lists them.

        Raises:
            CaptureError: An image is missing, and `missing` is not "skip".
        """
        kept = existing(self.paths, missing=missing, where=where)
        return replace(
            self,
            names=tuple(self.names[i] for i in kept),
            paths=tuple(self.paths[i] for i in kept),
            time=self.time[kept],
            poses=self.poses[kept],
        )


def read_views(path: Path, *, timed: bool = True) -> ViewSet:
    """The frames of one `transforms_<set>.json`.

    Args:
        path: The file.
        timed: Whether each frame must have a `time`.

    Raises:
        CaptureError: The file is missing or malformed, or a time is not in 0...1.
    """
    content = read_json(path)
    frames = frames_of(content, path)
    angle = number(content, "camera_angle_x", path)
    if not 0 < angle < math.pi:
        raise CaptureError(
            "`camera_angle_x` must lie between 0 and pi rad",
            where=path,
            got=angle,
            do="write the horizontal field of view in rad",
        )
    time = [_time(frame, f"{path}, frame {i}") if timed else 0.0 for i, frame in enumerate(frames)]
    files = [frame["file_path"] for frame in frames]
    return ViewSet(
        names=tuple(frame_name(file) for file in files),
        paths=tuple(image_path(path.parent, file) for file in files),
        time=np.array(time),
        poses=poses_of(frames, path),
        angle_rad=angle,
        focal_px=number({"focal": 0.0, **content}, "focal", path),
    )


def train_and_held_out(
    folder: Path, missing: Missing | None, *, timed: bool = True
) -> list[ViewSet]:
    """The training set of a Blender scene and, if there is one, its test or else validation set.

    Args:
        folder: Holds `transforms_train.json`.
        missing: What to do about images that do not exist.
        timed: Whether each frame must have a `time`.

    Raises:
        CaptureError: There is no training set, a file is malformed, or the cameras differ.
    """
    files = [folder / f"transforms_{name}.json" for name in SETS]
    if not files[0].is_file():
        raise CaptureError(
            "there is no transforms_train.json", where=folder, do="complete the download"
        )
    found = [path for path in files if path.is_file()][:2]
    sets = [read_views(path, timed=timed).existing(missing, path) for path in found]
    expect_one_camera(sets, folder)
    return sets


def has_times(path: Path) -> bool:
    """Whether the first frame of a `transforms_<set>.json` has a `time`."""
    try:
        frames = read_json(path).get("frames")
    except CaptureError:
        return False
    return isinstance(frames, list) and bool(frames) and "time" in frames[0]


def images_of(
    sets: Sequence[ViewSet], *, alpha: Alpha = "drop"
) -> Shaped[np.ndarray, "n h w c"] | None:
    """The images of all sets, or None if none of them exists.

    Raises:
        CaptureError: Some exist and some do not, or they differ in size or type.
    """
    paths = [path for one in sets for path in one.paths]
    if not any(path.is_file() for path in paths):
        return None
    return read_images(paths, alpha=alpha)


def expect_one_camera(sets: Sequence[ViewSet], where: Path) -> None:
    """Check that all sets share one camera.

    Raises:
        CaptureError: They do not.
    """
    seen = {(round(one.angle_rad, 6), round(one.focal_px, 3)) for one in sets}
    if len(seen) > 1:
        raise CaptureError(
            "the sets of a scene must share one camera",
            where=where,
            got=", ".join(
                f"camera_angle_x {angle}, focal {focal}" for angle, focal in sorted(seen)
            ),
            do="use sets of one camera",
        )


def _time(frame: dict[str, Any], where: str) -> float:
    time = number(frame, "time", where)
    if not 0 <= time <= 1 + 1e-5:
        raise CaptureError(
            "`time` must lie between 0 and 1",
            where=where,
            got=time,
            do="divide times by the duration of the recording",
        )
    return min(time, 1.0)
