"""nerfstudio's format: one `transforms.json` with intrinsics, lens and frames.

    fl_x fl_y cx cy w h               for all frames, or in every frame alike
    camera_model k1 k2 k3 k4 p1 p2    OPENCV, OPENCV_FISHEYE or PINHOLE, and its distortion
    frames                            file_path, transform_matrix
    train_filenames, test_filenames, val_filenames     optional
    ply_file_path                     optional: sparse scene points

Source: nerfstudio's documentation of its data format, and instant-ngp, where it comes from.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import (
    HOLD_OUT,
    PHOTOS,
    Photos,
    estimated_bounds,
    existing,
    photo_capture,
    same_camera,
)
from sharpfield.captures.layouts._transforms import (
    frame_name,
    frames_of,
    image_path,
    number,
    poses_of,
    read_json,
)
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.lenses import LENSES, PINHOLE
from sharpfield.storage.images import read_images
from sharpfield.storage.ply import columns, read_ply


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "transforms.json").is_file()


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene.

    Args:
        folder: Holds `transforms.json`.
        options: `bounds`, by default estimated from the focus of the cameras, since the format
            does not state them; `missing` images; `hold_out`, where there are no lists of frames.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    path = folder / "transforms.json"
    content = read_json(path)
    frames = sorted(frames_of(content, path), key=lambda frame: frame["file_path"])
    paths = [image_path(folder, frame["file_path"]) for frame in frames]
    kept = existing(paths, missing=options.missing, where=path)
    frames, paths = [frames[i] for i in kept], [paths[i] for i in kept]
    names = [frame_name(frame["file_path"]) for frame in frames]
    poses = poses_of(frames, path)
    known = PHOTOS if options.bounds else replace(PHOTOS, bounds="estimated")
    photos = Photos(
        images=read_images(paths),
        poses=poses,
        names=names,
        camera=same_camera([_camera({**content, **f}, path) for f in frames], names, where=path),
    )
    return photo_capture(
        photos,
        _split(content, names, path, options.hold_out or HOLD_OUT),
        bounds=options.bounds or estimated_bounds(poses),
        name=folder.resolve().name,
        source="nerfstudio",
        points=_points(folder, content, path),
        known=known,
    )


def _points(folder: Path, content: dict[str, Any], path: Path) -> Float64[np.ndarray, "m 3"] | None:
    file = content.get("ply_file_path")
    if file is None:
        return None
    if not isinstance(file, str):
        raise CaptureError(
            "`ply_file_path` must be text",
            where=path,
            got=file,
            do="write the path of the .ply file",
        )
    ply = folder / file
    points = columns(read_ply(ply), ("x", "y", "z"), where=ply).astype(np.float64)
    return points if len(points) else None


def _camera(content: dict[str, Any], path: Path) -> Camera:
    model = content.get("camera_model", "OPENCV")
    lenses = {lens.nerfstudio: lens for lens in LENSES.working().values() if lens.nerfstudio}
    if model not in lenses:
        raise CaptureError(
            "camera model is not supported",
            where=path,
            got=model,
            do=f"use one of {', '.join(lenses)}, or undistort the images",
        )
    lens = lenses[model]
    distortion = tuple(number({key: 0.0, **content}, key, path) for key in lens.coefficients)
    if lens.zero_is_pinhole and not any(distortion):
        lens, distortion = PINHOLE, ()
    fx = number(content, "fl_x", path)
    fy = number({"fl_y": fx, **content}, "fl_y", path)
    cx, cy = number(content, "cx", path), number(content, "cy", path)
    width, height = round(number(content, "w", path)), round(number(content, "h", path))
    return Camera(width, height, fx, fy, cx, cy, lens.name, distortion)


def _split(content: dict[str, Any], names: list[str], path: Path, hold_out: str) -> Split:
    listed = {
        kind: {frame_name(file) for file in content.get(f"{kind}_filenames", [])}
        for kind in ("train", "test", "val")
    }
    if not any(listed.values()):
        return split_by_rule(len(names), hold_out)
    test = listed["test"] or listed["val"]
    train = listed["train"] or set(names) - test
    known = np.array(names)
    split = Split(
        train=np.flatnonzero(np.isin(known, sorted(train))),
        test=np.flatnonzero(np.isin(known, sorted(test))),
    )
    if not len(split.train):
        raise CaptureError(
            "none of the frames is for training",
            where=f"{path}, key `train_filenames`",
            do="list frames by their `file_path`",
        )
    return split


LAYOUT = Layout("nerfstudio", recognise, read, "transforms.json", options=("missing",))
