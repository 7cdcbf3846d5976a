"""Pictures of a scene that moves, taken from known poses at known times: `transforms_<set>.json`.

Each frame has a `time` of 0...1 beside its pose, and the set has a `camera_angle_x`. The
recording is said to last one second, since these files know no other unit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from sharpfield.captures.transforms import (
    frame_name,
    frames_of,
    image_path,
    number,
    poses_of,
    read_json,
)
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Clock
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import Alpha, read_images

SECOND_US = 1_000_000
ONE_SECOND = Clock(0, SECOND_US)


@dataclass(frozen=True)
class TimedViews:
    """The frames of one set."""

    names: tuple[str, ...]
    paths: tuple[Path, ...]
    """Where images are, whether or not they are there."""
    time: Float64[np.ndarray, "n"]
    """0...1."""
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes."""
    angle_rad: float
    """Of view, from the left edge to the right."""
    focal_px: float
    """Stated instead; 0 if it is not."""

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.names)

    @property
    def t_us(self) -> Int64[np.ndarray, "n"]:
        """Times in us, the whole lasting one second."""
        return np.rint(self.time * SECOND_US).astype(np.int64)

    def camera(self, width: int, height: int) -> Camera:
        """The camera of images of a size."""
        focal = self.focal_px or 0.5 * width / math.tan(0.5 * self.angle_rad)
        return Camera(width, height, focal, focal, width / 2, height / 2)


def read_views(path: Path) -> TimedViews:
    """The frames of one `transforms_<set>.json`.

    Raises:
        CaptureError: It is missing or malformed, or a time is not in 0...1.
    """
    content = read_json(path)
    frames = frames_of(content, path)
    angle = number(content, "camera_angle_x", path)
    if not 0 < angle < math.pi:
        raise CaptureError("`camera_angle_x` must lie between 0 and pi rad", where=path, got=angle)
    time = np.array([_time(frame, f"{path}, frame {i}") for i, frame in enumerate(frames)])
    files = [frame["file_path"] for frame in frames]
    return TimedViews(
        names=tuple(frame_name(file) for file in files),
        paths=tuple(image_path(path.parent, file) for file in files),
        time=time,
        poses=poses_of(frames, path),
        angle_rad=angle,
        focal_px=number({"focal": 0.0, **content}, "focal", path),
    )


def has_times(path: Path) -> bool:
    """Whether the first frame of a `transforms_<set>.json` says when it was taken."""
    try:
        frames = read_json(path).get("frames")
    except CaptureError:
        return False
    return isinstance(frames, list) and bool(frames) and "time" in frames[0]


def images_of(
    sets: Sequence[TimedViews], *, alpha: Alpha = "drop"
) -> Shaped[np.ndarray, "n h w c"] | None:
    """The images of all sets, or None if none of them is there.

    Raises:
        CaptureError: Some are there and some are not, or they differ in size or type.
    """
    paths = [path for one in sets for path in one.paths]
    if not any(path.is_file() for path in paths):
        return None
    return read_images(paths, alpha=alpha)


def expect_one_camera(sets: Sequence[TimedViews], where: Path) -> None:
    """Make sure that all sets were taken with one camera.

    Raises:
        CaptureError: They were not.
    """
    seen = {(round(one.angle_rad, 6), round(one.focal_px, 3)) for one in sets}
    if len(seen) > 1:
        raise CaptureError(
            "the sets of a scene must share one camera",
            where=where,
            got=", ".join(
                f"camera_angle_x {angle}, focal {focal}" for angle, focal in sorted(seen)
            ),
        )


def _time(frame: dict[str, Any], where: str) -> float:
    time = number(frame, "time", where)
    if not 0 <= time <= 1 + 1e-5:
        raise CaptureError("`time` must lie between 0 and 1", where=where, got=time)
    return min(time, 1.0)
