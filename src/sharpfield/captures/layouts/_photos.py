"""Posed photographs: images with one pose each; motion during the exposure is unknown.

Each photo is a still track of its own and an instant; where its time is unknown, it is made up:
photo i at i seconds. The exposures do not show whether photos are blurred by motion: `Known.motion`
is "unknown", which makes recipes learn a blur kernel.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from sharpfield.captures.layout import Missing
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Note, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry.normalise import focus
from sharpfield.geometry.trajectory import Still
from sharpfield.storage.images import list_images

SECOND_US = 1_000_000

HOLD_OUT = "every:8"
"""The hold-out rule of LLFF, see `captures.splits`."""

PHOTOS = Known(motion="unknown")
"""Knowledge about photos with one pose each: they may be sharp or blurred."""

NEAR, FAR = 0.1, 10.0
"""Estimated depth bounds, relative to the distance of the cameras from their common focus."""


@dataclass(frozen=True)
class Photos:
    """Images of one camera with their poses."""

    images: Shaped[np.ndarray, "n h w c"]
    """As stored."""
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera, OpenCV axes."""
    names: Sequence[str]
    camera: Camera
    """It may be for another image size; it is scaled to the images."""
    encoding: str = "srgb"
    """How stored values relate to light, see `Frames`."""
    taken: tuple[Int64[np.ndarray, "n"], Clock] | None = None
    """When, in us; by default photo i at i seconds."""


def photo_capture(
    photos: Photos,
    split: Split,
    *,
    bounds: tuple[float, float],
    name: str,
    source: str,
    points: Float64[np.ndarray, "m 3"] | None = None,
    known: Known = PHOTOS,
    notes: Mapping[str, Note] | None = None,
) -> Capture:
    """A capture of single photos.

    Args:
        photos: The images.
        split: Training and held-out photos.
        bounds: Nearest and farthest depth of the scene.
        name: Name of the scene.
        source: The layout it was read from.
        points: Sparse scene points.
        known: What is known; by default everything but the motion of the camera.
        notes: Remarks for people.
    """
    count, height, width, _ = photos.images.shape
    taken_us, clock = photos.taken or (
        np.arange(count, dtype=np.int64) * SECOND_US,
        Clock(0, max(count - 1, 1) * SECOND_US),
    )
    frames = Frames(
        images=photos.images,
        exposure=Exposure(taken_us, taken_us),
        track=np.arange(count, dtype=np.int64),
        names=tuple(photos.names),
        encoding=photos.encoding,
    )
    return Capture(
        camera=scaled_camera(photos.camera, width, height, where=name),
        trajectory=Still(photos.poses),
        clock=clock,
        near=bounds[0],
        far=bounds[1],
        frames=frames,
        split=split,
        points=points,
        name=name,
        source=source,
        known=known,
        notes=dict(notes or {}),
    )


def choose_images(folder: Path, factor: int | None) -> Path:
    """The folder of images to read: `images_<factor>`, by default with the largest factor.

    `images` has a factor of 1 where there is no `images_1`.

    Raises:
        CaptureError: There are no images, or none of this factor.
    """
    found = {
        int(match[1] or 1): path
        for path in sorted(folder.glob("images*/"))
        if (match := re.fullmatch(r"images(?:_(\d+))?", path.name)) and list_images(path)
    }
    if not found or (factor is not None and factor not in found):
        raise CaptureError(
            "no images" if not found else f"there are no images of factor {factor}",
            where=folder,
            got=", ".join(path.name for path in found.values()) or "no images*/ with PNG or JPEG",
            do="put them in images_<factor>/, or images/ for full size",
        )
    return found[max(found) if factor is None else factor]


def existing(
    paths: Sequence[Path], *, missing: Missing | None, where: object
) -> Int64[np.ndarray, "m"]:
    """Indices of the files that exist.

    Raises:
        CaptureError: Some do not exist and `missing` is not "skip", or none exists.
    """
    found = np.array([path.is_file() for path in paths], bool)
    gone = np.flatnonzero(~found)
    if len(gone) and (missing != "skip" or not found.any()):
        listed = ", ".join(paths[i].name for i in gone[:3])
        raise CaptureError(
            f"{len(gone)} of {len(paths)} images are missing",
            where=where,
            got=f"no {listed}{', ...' if len(gone) > 3 else ''} in {paths[gone[0]].parent}",
            do="complete the download, or set the option `missing` to skip",
        )
    return np.flatnonzero(found)


def scaled_camera(camera: Camera, width: int, height: int, *, where: object) -> Camera:
    """The camera scaled to images of another size.

    Raises:
        CaptureError: The aspect ratio differs: the images were cropped, or are of another camera.
    """
    sx, sy = width / camera.width, height / camera.height
    # Each side may have been rounded to whole pixels, up or down.
    if abs(sx - sy) > max(1 / camera.width, 1 / camera.height):
        raise CaptureError(
            "images and intrinsics have different aspect ratios",
            where=where,
            got=f"images {width}x{height}, intrinsics for {camera.width}x{camera.height}",
            do="give intrinsics for these images; cropping moves the principal point",
        )
    return camera.resized(width, height)


def same_camera(cameras: Sequence[Camera], names: Sequence[str], *, where: object) -> Camera:
    """The camera that all photos share.

    Raises:
        CaptureError: Two photos have different cameras.
    """
    for camera, name in zip(cameras, names, strict=True):
        if not _agree(camera, cameras[0]):
            raise CaptureError(
                "all photos of a capture must share one camera",
                where=f"{where}, {names[0]} and {name}",
                got=f"{cameras[0]} and {camera}",
                do="undistort the photos to one camera, or use those of one camera only",
            )
    return cameras[0]


def depth_bounds(
    points: Float64[np.ndarray, "m 3"],
    poses: Float64[np.ndarray, "n 3 4"],
    seen: Int64[np.ndarray, "o 2"],
    *,
    where: object,
) -> tuple[float, float]:
    """Near and far: smallest 0.1th and largest 99.9th percentile of depth over the cameras.

    Args:
        points: Sparse scene points.
        poses: World-from-camera.
        seen: Observations: the camera (row of `poses`) and the point (row of `points`).
        where: The scene, for error messages.

    Raises:
        CaptureError: No observed point lies in front of its camera.

    Source: LLFF's `imgs2poses`.
    """
    camera, point = seen[np.argsort(seen[:, 0], kind="stable")].T
    # Depth along the optical axis of the observing camera.  [o]
    depth = ((points[point] - poses[camera, :, 3]) * poses[camera, :, 2]).sum(-1)
    camera, depth = camera[depth > 0], depth[depth > 0]
    each = np.split(depth, np.flatnonzero(np.diff(camera)) + 1)
    limits = [np.percentile(one, [0.1, 99.9]) for one in each if len(one)]
    if not limits:
        raise CaptureError(
            "no scene point lies in front of a camera that observed it: depth bounds are unknown",
            where=where,
            do="give the option `bounds`: near and far",
        )
    return float(np.min(limits)), float(np.max(limits))


def estimated_bounds(poses: Float64[np.ndarray, "n 3 4"]) -> tuple[float, float]:
    """Depth bounds estimated from the point nearest to all optical axes.

    Where the axes are parallel there is none; then it is put at ten times the spread of the
    cameras.
    """
    centre, forward = poses[:, :, 3], poses[:, :, 2]
    target = focus(poses)
    if target is not None:
        depth = float(np.median(((target - centre) * forward).sum(-1)))
    else:
        depth = 10 * (float(np.linalg.norm(centre - centre.mean(0), axis=-1).max()) or 1.0)
    return NEAR * depth, FAR * depth


def _agree(a: Camera, b: Camera) -> bool:
    if (a.size, a.lens) != (b.size, b.lens):
        return False
    focal_and_centre = [(c.fx_px, c.fy_px, c.cx_px, c.cy_px) for c in (a, b)]
    return np.allclose(*focal_and_centre, rtol=1e-5) and np.allclose(
        a.distortion, b.distortion, atol=1e-6
    )
