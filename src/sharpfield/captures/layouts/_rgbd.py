"""Recordings of depth cameras: colour, depth and a pose for each frame; common to all layouts.

The reader of a layout locates the files (`RgbdFrames`). Frames without a usable pose are left out,
and `notes["dropped"]` lists them. As for all photos with one pose each (`layouts._photos`), every
frame is an instant on a still track of its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Shaped, UInt8, UInt16

from sharpfield.captures.layouts._photos import Photos, photo_capture
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import MILLIMETRE, DepthMaps
from sharpfield.storage.images import image_stack, read_image

BOUNDS = (0.1, 8.0)
"""Nearest and farthest depth of rooms, in metres."""
SIZE = (640, 480)
"""Maximum size of images, in landscape orientation; larger ones are downscaled."""
SAME_ASPECT = 0.02
"""Images whose aspect ratio differs by less are scaled to exactly that size, as published; others
keep their aspect ratio."""
OFF_CENTRE = 0.25
"""Maximum distance of the principal point from the image centre, relative to the image size."""
FARTHEST_POSE = 30.0
"""Poses with a larger entry (metres) are tracking failures."""
LISTED = 6
"""Number of dropped frames that are listed by name."""

PUBLISHED_SPLIT = "train:5"
"""One frame in five is for training, see `captures.splits`."""


@dataclass(frozen=True)
class RgbdFrames:
    """The frames of a recording, before any is decoded."""

    names: Sequence[str]
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes; not finite where tracking failed."""
    colour: Callable[[int], UInt8[np.ndarray, "h w 3"]]
    """Decodes the colour image of a frame, given its index in the recording."""
    depth: Callable[[int], UInt16[np.ndarray, "y x"]] | None
    """Decodes the depth of a frame, in mm, 0 where unknown."""
    measured: Bool[np.ndarray, "n"]
    """Which frames have a depth map; without one, depth is unknown in all pixels."""
    camera: Camera
    """Of the colour images as stored."""
    depth_camera: Camera
    sources: Sequence[Path]
    """The files of the colour images."""
    depth_sources: Sequence[Path]
    """The files of the depth maps."""


def rgbd_capture(
    frames: RgbdFrames,
    hold_out: str | None,
    *,
    folder: Path,
    source: str,
    points: Float64[np.ndarray, "m 3"] | None = None,
    split: Split | None = None,
) -> Capture:
    """A capture from a recording of a depth camera.

    Args:
        frames: The frames.
        hold_out: Rule for the frames whose pose is usable; by default `PUBLISHED_SPLIT`.
        folder: Folder of the recording, which gives its name.
        source: The layout.
        points: Sparse scene points.
        split: Of the frames whose pose is usable, instead of a rule.

    Raises:
        CaptureError: No frame has a pose, or an image cannot be read.
    """
    usable = usable_poses(frames.poses)
    kept = np.flatnonzero(usable)
    if not len(kept):
        raise CaptureError(
            "no frame has a usable pose",
            where=folder,
            got=f"{len(usable)} frames",
            do=f"poses must be finite, with entries below {FARTHEST_POSE:g} m",
        )
    camera = downscaled_camera(frames.camera, SIZE)
    images = image_stack(
        kept.tolist(),
        lambda row: _sized(frames.colour(row), camera.size),
        sources=frames.sources,
        kind=f"colour {camera.width}x{camera.height}",
    )
    depth = None
    if frames.depth is not None and frames.measured[kept].any():
        decode, unknown = frames.depth, np.zeros(frames.depth_camera.size[::-1], np.uint16)
        maps = image_stack(
            kept.tolist(),
            lambda row: decode(row) if frames.measured[row] else unknown,
            sources=frames.depth_sources,
            kind="depth",
        )
        depth = DepthMaps(maps, frames.depth_camera, MILLIMETRE)
    photos = Photos(
        images=images,
        poses=frames.poses[kept],
        names=[frames.names[i] for i in kept.tolist()],
        camera=camera,
    )
    made = photo_capture(
        photos,
        split or split_by_rule(len(kept), hold_out or PUBLISHED_SPLIT),
        bounds=BOUNDS,
        name=folder.resolve().name,
        source=source,
        points=points,
        notes=_notes(frames, usable),
    )
    return replace(made, depth=depth)


def usable_poses(poses: Float64[np.ndarray, "n 3 4"]) -> Bool[np.ndarray, "n"]:
    """Which poses are finite and not farther away than `FARTHEST_POSE`."""
    largest = np.abs(poses).reshape(len(poses), -1).max(1)
    return np.isfinite(largest) & (largest < FARTHEST_POSE)


def downscaled_camera(camera: Camera, largest: tuple[int, int]) -> Camera:
    """The camera of images that are downscaled if larger than a size, see `SAME_ASPECT`."""
    wide, high = largest if camera.width >= camera.height else largest[::-1]
    if camera.width <= wide and camera.height <= high:
        return camera
    sx, sy = wide / camera.width, high / camera.height
    if abs(sx / sy - 1) > SAME_ASPECT:
        wide, high = (max(round(side * min(sx, sy)), 1) for side in camera.size)
    return camera.resized(wide, high)


def pinhole(matrix: Shaped[np.ndarray, "r c"], size: tuple[int, int], *, where: object) -> Camera:
    """A pinhole camera from an intrinsic matrix, 3x3 or larger, for pixel centres at +0.5.

    Raises:
        CaptureError: It is not such a matrix, or it is for images of another size.
    """
    if matrix.ndim != 2 or min(matrix.shape) < 3 or not np.isfinite(matrix[:3, :3]).all():
        raise CaptureError(
            "intrinsics must be a finite matrix of 3x3 or more",
            where=where,
            got=f"shape {matrix.shape}",
            do="write fx 0 cx / 0 fy cy / 0 0 1",
        )
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    off = max(abs(cx / size[0] - 0.5), abs(cy / size[1] - 0.5))
    if off > OFF_CENTRE or not min(fx, fy) > 0:
        raise CaptureError(
            "the intrinsics do not belong to the images",
            where=where,
            got=f"focal lengths {fx:.4g}, {fy:.4g}, principal point {cx:.4g}, {cy:.4g} px;"
            f" images of {size[0]}x{size[1]}",
            do="give intrinsics for images of this size",
        )
    return Camera(*size, fx, fy, cx, cy)


def read_matrix(path: Path) -> Shaped[np.ndarray, "r c"]:
    """Read a text of numbers, a row per line; `inf` and `nan` are allowed.

    Raises:
        CaptureError: The file is missing, or is not a table of numbers.
    """
    try:
        return np.loadtxt(path, ndmin=2)
    except FileNotFoundError:
        raise CaptureError("file not found", where=path, do="check the path") from None
    except (ValueError, UnicodeDecodeError) as error:
        raise CaptureError(
            "cannot read the numbers of a text",
            where=path,
            got=error,
            do="write numbers only, a row per line",
        ) from None


def read_pose(path: Path) -> Float64[np.ndarray, "3 4"]:
    """Read a world-from-camera pose from a text with a 3x4 or 4x4 matrix.

    Raises:
        CaptureError: The file is missing, or the matrix has another shape.
    """
    matrix = read_matrix(path)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise CaptureError(
            "a pose must have 4 columns and 3 or 4 rows",
            where=path,
            got=matrix.shape,
            do="write a 3x4 or 4x4 matrix, a row per line",
        )
    return matrix[:3].astype(np.float64)


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an 8-bit image as RGB.

    Raises:
        CaptureError: The image does not have 8 bits.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        raise CaptureError(
            "a colour image must have 8 bits",
            where=path,
            got=image.dtype,
            do="convert it to 8 bits",
        )
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.shape[-1] == 1 else image


def _sized(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "y x 3"]:
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _notes(frames: RgbdFrames, usable: Bool[np.ndarray, "n"]) -> dict[str, float | str]:
    """Which frames were left out, and which have no depth map."""
    notes: dict[str, float | str] = {}
    if not usable.all():
        notes["dropped"] = _listed(frames, ~usable, "have no usable pose")
    if frames.depth is not None and not frames.measured[usable].all():
        notes["without_depth"] = _listed(frames, usable & ~frames.measured, "have no depth")
    return notes


def _listed(frames: RgbdFrames, which: Bool[np.ndarray, "n"], what: str) -> str:
    rows = np.flatnonzero(which).tolist()
    named = ", ".join(frames.names[i] for i in rows[:LISTED]) + (
        ", ..." if len(rows) > LISTED else ""
    )
    return f"{len(rows)} of {len(which)} frames {what}: {named}"
