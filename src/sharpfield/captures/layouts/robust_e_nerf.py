"""Robust e-NeRF's data (Deblur e-NeRF's too): one event camera that moves.

    raw_events.npz            position [n, 2], timestamp in ns, polarity
    camera_poses.npz          T_wc_position, T_wc_orientation (quaternion x y z w), T_wc_timestamp;
                              world-from-camera, OpenCV axes
    camera_calibration.npz    intrinsics, distortion, img_height, img_width, bayer_pattern,
                              thresholds, refractory period in ns
    views/transforms_test.json, or ../views/     test images, optional

Their intrinsics have the origin at the centre of the first pixel, ours at its corner. Poses are
interpolated linearly. Images of another size than the event camera, or other than PNG or JPEG, are
left out, with a note.

Source: Low and Lee, *Robust e-NeRF* (ICCV 2023), and its data loader.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Shaped

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import estimated_bounds
from sharpfield.captures.layouts._transforms import (
    frame_name,
    frames_of,
    image_path,
    poses_of,
    read_json,
)
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Split, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.lenses import PINHOLE, lens_in_calibration
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped, Tracks
from sharpfield.storage.arrays import load_arrays
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_columns import whole_us
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.images import SUFFIXES, read_images

EVENTS, POSES, CALIBRATION = "raw_events.npz", "camera_poses.npz", "camera_calibration.npz"

DISTORTION = ("plumb_bob", "equidistant")
"""Distortion models of this layout, each with four coefficients."""

Arrays = dict[str, Shaped[np.ndarray, "..."]]


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return all((folder / file).is_file() for file in (EVENTS, POSES, CALIBRATION))


def read(folder: Path, _options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read the events, the poses, and the test images.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    calibration = _arrays(folder / CALIBRATION, ("intrinsics", "img_height", "img_width"))
    camera = _camera(calibration, folder / CALIBRATION)
    path = _trajectory(folder / POSES)
    with open_events(folder / EVENTS, size=camera.size) as file:
        events = read_events(replace(file, bayer=str(calibration.get("bayer_pattern", ""))))
    near, far = estimated_bounds(path.poses)
    views = _views(folder, camera, path.clock)
    none = np.zeros(0, np.int64)
    return Capture(
        camera=camera,
        trajectory=path if views.frames is None else Tracks([path], views.poses),
        clock=path.clock,
        near=near,
        far=far,
        frames=views.frames,
        events=events,
        split=Split(none, np.arange(len(views.poses))),
        name=folder.resolve().name,
        source="robust-e-nerf",
        known=_known(calibration),
        notes={"views": views.left_out} if views.left_out else {},
    )


def _arrays(path: Path, needed: tuple[str, ...]) -> Arrays:
    found = load_arrays(path)
    lacking = [name for name in needed if name not in found]
    if lacking:
        raise CaptureError(
            f"array {lacking[0]} is missing",
            where=path,
            got=", ".join(found) or "no arrays",
            do="add it",
        )
    return found


def _camera(calibration: Arrays, path: Path) -> Camera:
    matrix = np.asarray(calibration["intrinsics"], np.float64)
    coefficients = np.atleast_1d(np.asarray(calibration.get("distortion_params", []), np.float64))
    model = str(calibration.get("distortion_model", ""))
    lens, distortion = PINHOLE, ()
    if coefficients.size and coefficients.any():
        lens = lens_in_calibration(model)
        if lens is None or coefficients.shape != (4,) or lens.fewest != 4:
            raise CaptureError(
                "distortion model is not supported",
                where=path,
                got=f"{model!r} with {coefficients.size} coefficients",
                do=f"use one of {', '.join(DISTORTION)} with 4, or undistort the events",
            )
        distortion = lens.padded(coefficients.tolist())
    width, height = (int(calibration[name].item()) for name in ("img_width", "img_height"))
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    cx, cy = float(matrix[0, 2]) + 0.5, float(matrix[1, 2]) + 0.5
    return Camera(width, height, fx, fy, cx, cy, lens.name, distortion)


def _trajectory(path: Path) -> Stamped:
    names = ("T_wc_position", "T_wc_orientation", "T_wc_timestamp")
    found = _arrays(path, names)
    position, xyzw, stamps = (found[name] for name in names)
    if not (len(position) == len(xyzw) == len(stamps) > 1):
        raise CaptureError(
            "there must be a position, an orientation and a time for each of several poses",
            where=path,
            got=f"{len(position)}, {len(xyzw)} and {len(stamps)}",
            do="complete the download",
        )
    wxyz = torch.from_numpy(np.roll(np.asarray(xyzw, np.float64), 1, axis=1))
    rotation = se3.rotation_from_quaternion(wxyz / wxyz.norm(dim=-1, keepdim=True)).numpy()
    poses = np.concatenate([rotation, np.asarray(position, np.float64)[:, :, None]], -1)
    times_us = whole_us(stamps, "ns", path)
    clock = Clock(int(times_us[0]), max(int(times_us[-1] - times_us[0]), 1))
    return Stamped(times_us, poses, clock, "linear")


def _known(calibration: Arrays) -> Known:
    """Thresholds and refractory period where known; a real camera's are NaN or absent."""

    def number(name: str) -> float | None:
        value = float(calibration[name].item()) if name in calibration else np.nan
        return value if np.isfinite(value) else None

    negative, positive = number("neg_contrast_threshold"), number("pos_contrast_threshold")
    refractory_ns = number("refractory_period")
    return Known(
        bounds="estimated",
        thresholds=Thresholds(negative, positive) if negative and positive else None,
        refractory_us=None if refractory_ns is None else refractory_ns * 1e-3,
    )


@dataclass(frozen=True)
class _Views:
    """Test images, each on a still track of its own."""

    frames: Frames | None = None
    poses: Float64[np.ndarray, "v 3 4"] = field(default_factory=lambda: np.zeros((0, 3, 4)))
    left_out: str = ""
    """Why listed images were left out."""


def _views(folder: Path, camera: Camera, clock: Clock) -> _Views:
    listed = [
        parent / "views" / f"transforms_{name}.json"
        for parent in (folder, folder.resolve().parent)
        for name in ("test", "val")
    ]
    path = next((file for file in listed if file.is_file()), None)
    if path is None:
        return _Views()
    frames = frames_of(read_json(path), path)
    files = [image_path(path.parent, frame["file_path"]) for frame in frames]
    if not all(file.is_file() for file in files):
        return _Views(left_out=f"{path.name} names images that are not {' or '.join(SUFFIXES)}")
    images = read_images(files, alpha="white")
    if images.shape[1:3] != (camera.height, camera.width):
        return _Views(left_out=f"{path.name} is of a camera of another size")
    at = np.full(len(frames), clock.origin_us)
    seen = Frames(
        images=images,
        exposure=Exposure(at, at),
        track=1 + np.arange(len(frames)),
        names=tuple(frame_name(frame["file_path"]) for frame in frames),
        encoding="srgb",
    )
    return _Views(seen, poses_of(frames, path))


LAYOUT = Layout(
    "robust-e-nerf", recognise, read, "raw_events.npz, camera_poses.npz and camera_calibration.npz"
)
