"""Recordings of depth cameras: colour, depth and a pose for each frame, in files of many layouts.

A layout's reader says where things are (`RgbdFrames`); what is common happens here. Frames without
a usable pose are left out, and `notes["dropped"]` says so. As for all photos with one pose each
(`captures.photos`), every frame is an instant on a still track of its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Shaped, UInt8, UInt16

from sharpfield.captures.mapped_images import mapped
from sharpfield.captures.photos import Photos, photo_capture
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Split
from sharpfield.core.depth import MILLIMETRE, DepthMaps
from sharpfield.core.errors import CaptureError

BOUNDS = (0.1, 8.0)
"""Nearest and farthest depth of rooms, in metres."""
SIZE = (640, 480)
"""Larger images are brought to this size."""
FARTHEST_POSE = 30.0
"""Poses with a larger entry are failures of tracking, not places in a room."""
NAMED = 6
"""Dropped frames that are named."""

Row = int
"""Number of a frame in its recording."""


@dataclass(frozen=True)
class RgbdFrames:
    """Where the frames of a recording are, before any is decoded."""

    names: Sequence[str]
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes; not finite where tracking failed."""
    colour: Callable[[Row], UInt8[np.ndarray, "h w 3"]]
    """Decodes the image of a frame."""
    depth: Callable[[Row], UInt16[np.ndarray, "y x"]] | None
    """Decodes the depth of a frame, in mm, 0 where unknown."""
    camera: Camera
    """Of the colour images as stored."""
    depth_camera: Camera
    sources: Sequence[Path]
    """The files all of it comes from."""


def rgbd_capture(
    frames: RgbdFrames,
    split: Callable[[int], Split],
    *,
    folder: Path,
    source: str,
    bounds: tuple[float, float] = BOUNDS,
    encoding: str = "srgb",
    points: Float64[np.ndarray, "m 3"] | None = None,
) -> Capture:
    """A capture of a depth camera's recording.

    Args:
        frames: Where its frames are.
        split: What to hold out of so many frames; poses that failed do not count.
        folder: Of the recording; names it.
        source: The layout.
        bounds: Nearest and farthest depth.
        encoding: How stored values relate to light.
        points: Scene points that came with it.

    Raises:
        CaptureError: No frame has a pose, or an image cannot be read.
    """
    usable = usable_poses(frames.poses)
    kept = np.flatnonzero(usable)
    if not len(kept):
        raise CaptureError("no frame has a usable pose", where=folder, got=f"{len(usable)} frames")
    camera = resized(frames.camera, SIZE)
    images = mapped(
        kept.tolist(),
        lambda row: _sized(frames.colour(row), camera.size),
        sources=frames.sources,
        kind=f"colour {camera.width}x{camera.height}",
    )
    depth = None
    if frames.depth is not None:
        maps = mapped(kept.tolist(), frames.depth, sources=frames.sources, kind="depth")
        depth = DepthMaps(maps, frames.depth_camera, MILLIMETRE)
    photos = Photos(
        images=images,
        poses=frames.poses[kept],
        names=[frames.names[i] for i in kept.tolist()],
        camera=camera,
        encoding=encoding,
    )
    made = photo_capture(
        photos,
        split(len(kept)),
        bounds=bounds,
        name=folder.resolve().name,
        source=source,
        points=points,
        notes=_dropped(frames.names, usable),
    )
    return replace(made, depth=depth)


def usable_poses(poses: Float64[np.ndarray, "n 3 4"]) -> Bool[np.ndarray, "n"]:
    """Which poses are finite and within a room."""
    largest = np.abs(poses).reshape(len(poses), -1).max(1)
    return np.isfinite(largest) & (largest < FARTHEST_POSE)


def resized(camera: Camera, most: tuple[int, int]) -> Camera:
    """A camera whose images are brought to a size if they are larger; sides scale separately."""
    if camera.width <= most[0] and camera.height <= most[1]:
        return camera
    sx, sy = most[0] / camera.width, most[1] / camera.height
    return replace(
        camera,
        width=most[0],
        height=most[1],
        fx_px=camera.fx_px * sx,
        fy_px=camera.fy_px * sy,
        cx_px=camera.cx_px * sx,
        cy_px=camera.cy_px * sy,
    )


def pinhole(matrix: Shaped[np.ndarray, "r c"], size: tuple[int, int], *, where: object) -> Camera:
    """A camera of an intrinsic matrix, 3x3 or larger, for pixel centres at +0.5.

    Raises:
        CaptureError: It is no such matrix.
    """
    if matrix.ndim != 2 or min(matrix.shape) < 3 or not np.isfinite(matrix[:3, :3]).all():
        raise CaptureError("cannot read the intrinsics", where=where, got=f"{matrix.shape} numbers")
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(*size, fx, fy, cx, cy)


def read_matrix(path: Path) -> Shaped[np.ndarray, "r c"]:
    """The numbers of a text, a row each line; `inf` and `nan` are numbers, too.

    Raises:
        CaptureError: It is missing, or no table of numbers.
    """
    try:
        return np.loadtxt(path, ndmin=2)
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except (ValueError, UnicodeDecodeError) as error:
        raise CaptureError("cannot read the numbers of a text", where=path, got=error) from None


def read_pose(path: Path) -> Float64[np.ndarray, "3 4"]:
    """World-from-camera, from a text with a 3x4 or 4x4 matrix.

    Raises:
        CaptureError: It is missing, or has another shape.
    """
    matrix = read_matrix(path)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise CaptureError(
            "a pose must have 4 columns and 3 or 4 rows", where=path, got=matrix.shape
        )
    return matrix[:3].astype(np.float64)


def _sized(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "y x 3"]:
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _dropped(names: Sequence[str], usable: Bool[np.ndarray, "n"]) -> dict[str, float | str]:
    gone = np.flatnonzero(~usable).tolist()
    if not gone:
        return {}
    named = ", ".join(names[i] for i in gone[:NAMED]) + (", ..." if len(gone) > NAMED else "")
    return {"dropped": f"{len(gone)} of {len(usable)} frames have no usable pose: {named}"}
