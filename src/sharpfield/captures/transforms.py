"""What the dialects of `transforms.json` share: OpenGL camera-to-world matrices and image paths.

The columns of `transform_matrix` are the camera's right, up and backward axes and its centre in
the world; here the axes become OpenCV's right, down, forward.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from sharpfield.core.errors import CaptureError
from sharpfield.geometry.trajectory import check_poses
from sharpfield.storage.images import SUFFIXES

OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0, 1.0])


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        CaptureError: The file is missing or is not one.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError("not a JSON file", where=path, got=error) from None
    if not isinstance(content, dict):
        raise CaptureError("must be a JSON object", where=path, got=type(content).__name__)
    return content


def frames_of(content: dict[str, Any], where: object) -> list[dict[str, Any]]:
    """The list of frames, each with `file_path` and `transform_matrix`.

    Raises:
        CaptureError: There is none, or a frame lacks one of these.
    """
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError("there are no frames", where=f"{where}, key `frames`")
    for i, frame in enumerate(frames):
        for key, kind in (("file_path", str), ("transform_matrix", list)):
            if not isinstance(frame, dict) or not isinstance(frame.get(key), kind):
                raise CaptureError(f"a frame lacks `{key}`", where=f"{where}, frame {i}")
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
        raise CaptureError("each `transform_matrix` must be 4x4 or 3x4 numbers", where=where)
    poses = matrices[:, :3] * OPENCV_FROM_OPENGL
    check_poses(poses, where)
    return poses


def image_path(folder: Path, file_path: str) -> Path:
    """Where a frame's image is; the suffix may be left out in the file."""
    path = folder / file_path
    if path.suffix.lower() in SUFFIXES:
        return path
    named = [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    return next((candidate for candidate in named if candidate.is_file()), named[0])


def frame_name(file_path: str) -> str:
    """A frame's name: its path without suffix, e.g. `train/r_0`."""
    path = Path(file_path)
    if path.suffix.lower() in SUFFIXES:
        path = path.with_suffix("")
    return path.as_posix()


def number(content: dict[str, Any], key: str, where: object) -> float:
    """A required number.

    Raises:
        CaptureError: It is missing or no number.
    """
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CaptureError(f"`{key}` must be a number", where=where, got=value)
    return float(value)
