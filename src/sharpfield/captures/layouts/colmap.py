"""Photos with a COLMAP reconstruction.

    images/ or images_N/    photos; images_N are N times smaller
    sparse/0/               cameras, images and points3D, .bin or .txt;
                            or in sparse/ or colmap/sparse/0/

Intrinsics are scaled to the size of the images that are read. Depth bounds come from the points.

COLMAP stores camera-from-world quaternions and translations in OpenCV axes, with the centre of
the first pixel at (0.5, 0.5); here they become world-from-camera matrices, sorted by image name.

Source: https://colmap.github.io/format.html and the writers in COLMAP's `reconstruction_io`.
"""

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import (
    HOLD_OUT,
    Photos,
    choose_images,
    depth_bounds,
    existing,
    photo_capture,
    same_camera,
)
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.lenses import LENSES, ColmapModel, Lens
from sharpfield.geometry import se3
from sharpfield.storage.images import SUFFIXES, read_images

INTRINSICS = ("f", "fx", "fy", "cx", "cy")

FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "")
"""Subfolders of a scene that may hold a model."""

OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
TRACK = np.dtype([("image", "<u4"), ("observation", "<u4")])


@dataclass(frozen=True)
class Model:
    """A sparse reconstruction; rows are sorted by image name."""

    names: tuple[str, ...]
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera."""
    cameras: tuple[Camera, ...]
    """One for each image."""
    points: Float64[np.ndarray, "m 3"]
    seen: Int64[np.ndarray, "o 2"]
    """Observations: image (row) and point (row)."""


@dataclass(frozen=True)
class _Image:
    number: int
    wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


@dataclass(frozen=True)
class _Points:
    xyz: Float64[np.ndarray, "m 3"]
    image: Int64[np.ndarray, "o"]
    """COLMAP's number of the image of each observation, ordered by point."""
    row: Int64[np.ndarray, "o"]
    """The row of the point of each observation."""


def find_model(folder: Path) -> Path | None:
    """The folder of the model of a scene, or None."""
    for name in FOLDERS:
        if any((folder / name / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder / name
    return None


def read_model(folder: Path) -> Model:
    """Read a model; binary files are preferred where there are both.

    Raises:
        CaptureError: A file is missing, truncated or malformed, or a camera model is unknown.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    binary = suffix == ".bin"
    cameras_path, images_path, points_path = (
        folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")
    )
    cameras = (_binary_cameras if binary else _text_cameras)(cameras_path)
    images = (_binary_images if binary else _text_images)(images_path)
    points = (_binary_points if binary else _text_points)(points_path)
    if not images:
        raise CaptureError(
            "the reconstruction holds no images", where=images_path, do="register some with COLMAP"
        )
    images = sorted(images, key=lambda image: image.name)
    for image in images:
        if image.camera not in cameras:
            raise CaptureError(
                "an image refers to a camera that does not exist",
                where=f"{images_path}, {image.name}",
                got=f"camera {image.camera} of {sorted(cameras)}",
                do="export the model again",
            )
    row_of = {image.number: row for row, image in enumerate(images)}
    rows = np.array([row_of.get(int(number), -1) for number in points.image], np.int64)
    seen = np.stack([rows, points.row], -1)[rows >= 0]
    return Model(
        names=tuple(image.name for image in images),
        poses=_world_from_camera(images),
        cameras=tuple(cameras[image.camera] for image in images),
        points=points.xyz,
        seen=seen,
    )


def camera_of(
    model: str, width: int, height: int, parameters: tuple[float, ...], *, where: object
) -> Camera:
    """The camera for a model name and parameters of COLMAP.

    Raises:
        CaptureError: The model is not supported.
    """
    known, given = colmap_models(), {}
    if model in known and len(parameters) == len(known[model][0].parameters):
        given = dict(zip(known[model][0].parameters, parameters, strict=True))
        beyond = set(given) - {*INTRINSICS, *known[model][1].coefficients}
    if not given or any(given[name] for name in beyond):
        raise CaptureError(
            f"camera model {model} is not supported",
            where=where,
            got=f"{len(parameters)} parameters",
            do=f"use one of {', '.join(known)}, or undistort with `colmap image_undistorter`",
        )
    lens = known[model][1]
    fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    inner = (width, height, fx, fy, given["cx"], given["cy"])
    distortion = tuple(given.get(name, 0.0) for name in lens.coefficients)
    if lens.zero_is_pinhole and not any(distortion):
        return Camera(*inner)
    return Camera(*inner, lens.name, distortion)


def colmap_models() -> dict[str, tuple[ColmapModel, Lens]]:
    """COLMAP's camera models, each with the lens that covers it."""
    return {
        theirs.name: (theirs, lens) for lens in LENSES.working().values() for theirs in lens.colmap
    }


def _world_from_camera(images: list[_Image]) -> Float64[np.ndarray, "n 3 4"]:
    wxyz = torch.tensor([image.wxyz for image in images], dtype=torch.float64)
    translation = torch.tensor([image.translation for image in images], dtype=torch.float64)
    rotation = se3.rotation_from_quaternion(wxyz)
    return se3.inverse(torch.cat([rotation, translation[..., None]], -1)).numpy()


class _Bytes:
    """Reads a binary file from its start; a truncated file is an error."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, _found(path).read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Little-endian numbers, as in `struct`."""
        size = struct.calcsize("<" + layout)
        self._need(size)
        values = struct.unpack_from("<" + layout, self.data, self.position)
        self.position += size
        return values

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        """`count` records."""
        self._need(count * dtype.itemsize)
        values = np.frombuffer(self.data, dtype, count, self.position)
        self.position += count * dtype.itemsize
        return values

    def text(self) -> str:
        """Characters up to a zero byte."""
        end = self.data.find(b"\0", self.position)
        self._need(end - self.position + 1 if end >= 0 else len(self.data) + 1)
        value = self.data[self.position : end].decode("utf-8", "replace")
        self.position = end + 1
        return value

    def _need(self, size: int) -> None:
        if self.position + size > len(self.data):
            raise CaptureError(
                "COLMAP file is truncated",
                where=self.path,
                got=f"{len(self.data)} bytes; more are needed after byte {self.position}",
                do="copy it again",
            )


def _binary_cameras(path: Path) -> dict[int, Camera]:
    data, cameras = _Bytes(path), {}
    for _ in range(data.take("Q")[0]):
        number, model, width, height = data.take("IiQQ")
        known = {theirs.number: theirs for theirs, _ in colmap_models().values()}
        name = known[model].name if model in known else f"number {model}"
        count = len(known[model].parameters) if model in known else 0
        cameras[number] = camera_of(name, width, height, data.take(f"{count}d"), where=path)
    return cameras


def _binary_images(path: Path) -> list[_Image]:
    data, images = _Bytes(path), []
    for _ in range(data.take("Q")[0]):
        number, *pose, camera = data.take("I7dI")
        images.append(_Image(number, tuple(pose[:4]), tuple(pose[4:]), camera, data.text()))
        data.array(OBSERVATION, data.take("Q")[0])
    return images


def _binary_points(path: Path) -> _Points:
    data, xyz, tracks = _Bytes(path), [], []
    for _ in range(data.take("Q")[0]):
        _, *position = data.take("Q3d3Bd")[:4]
        xyz.append(position)
        tracks.append(data.array(TRACK, data.take("Q")[0])["image"])
    return _points(xyz, tracks)


def _text_cameras(path: Path) -> dict[int, Camera]:
    cameras = {}
    for line in filter(None, _lines(path)):
        with _parsing(path, line):
            number, model, width, height, *parameters = line.split()
            size, numbers = (int(width), int(height)), tuple(map(float, parameters))
            cameras[int(number)] = camera_of(model, *size, numbers, where=path)
    return cameras


def _text_images(path: Path) -> list[_Image]:
    images = []
    # Every second line lists 2-D points, and may be empty.
    for line in filter(None, _lines(path)[::2]):
        with _parsing(path, line):
            number, *rest = line.split(maxsplit=9)
            pose, camera, name = [float(v) for v in rest[:7]], int(rest[7]), rest[8]
            images.append(_Image(int(number), tuple(pose[:4]), tuple(pose[4:]), camera, name))
    return images


def _text_points(path: Path) -> _Points:
    xyz, tracks = [], []
    for line in filter(None, _lines(path)):
        with _parsing(path, line):
            fields = line.split()
            xyz.append([float(v) for v in fields[1:4]])
            tracks.append(np.array(fields[8::2], np.int64))
    return _points(xyz, tracks)


def _points(xyz: list[list[float]], tracks: list[np.ndarray]) -> _Points:
    """Points, and the images of their observations."""
    lengths = [len(track) for track in tracks]
    return _Points(
        xyz=np.array(xyz, np.float64).reshape(-1, 3),
        image=np.concatenate([*tracks, np.zeros(0, np.int64)]).astype(np.int64),
        row=np.repeat(np.arange(len(xyz), dtype=np.int64), lengths),
    )


def _lines(path: Path) -> list[str]:
    text = _found(path).read_text(encoding="utf-8", errors="replace")
    return [line for line in text.splitlines() if not line.startswith("#")]


@contextlib.contextmanager
def _parsing(path: Path, line: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError):
        raise CaptureError(
            "cannot read a line of a COLMAP file", where=path, got=line, do="export the model again"
        ) from None


def _found(path: Path) -> Path:
    if not path.is_file():
        raise CaptureError(
            "COLMAP file not found",
            where=path,
            do="a model is cameras, images and points3D, all .bin or all .txt",
        )
    return path


def recognise(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model and images, and no pose table of another layout."""
    return (
        find_model(folder) is not None
        and any(folder.glob("images*/"))
        and not (folder / "poses_bounds.npy").exists()
        and not (folder / "transforms.json").exists()
    )


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read photos and their reconstruction.

    Args:
        folder: Holds what the module describes.
        options: `factor` of the images, by default the smallest there are; `hold_out`; `bounds`,
            by default what the points show; `missing` photos of the model.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    model_folder = find_model(folder)
    if model_folder is None:
        raise CaptureError("no COLMAP model", where=folder, do="put one in sparse/0")
    model = read_model(model_folder)
    image_folder = choose_images(folder, options.factor)
    paths = [_with_any_suffix(image_folder / name) for name in model.names]
    kept = existing(paths, missing=options.missing, where=model_folder)
    names = [model.names[i] for i in kept]
    photos = Photos(
        images=read_images([paths[i] for i in kept]),
        poses=model.poses[kept],
        names=[Path(name).with_suffix("").as_posix() for name in names],
        camera=same_camera([model.cameras[i] for i in kept], names, where=model_folder),
    )
    return photo_capture(
        photos,
        split_by_rule(len(kept), options.hold_out or HOLD_OUT),
        bounds=options.bounds
        or depth_bounds(model.points, model.poses, model.seen, where=model_folder),
        name=folder.resolve().name,
        source="colmap",
        points=model.points if len(model.points) else None,
    )


def _with_any_suffix(path: Path) -> Path:
    """The path of a photo; downscaled copies may have another suffix than the model states."""
    others = (path.with_suffix(s) for suffix in SUFFIXES for s in (suffix, suffix.upper()))
    candidates = [path, *others]
    return next((candidate for candidate in candidates if candidate.is_file()), path)


LAYOUT = Layout(
    "colmap", recognise, read, "sparse/0/cameras.bin and images*/", options=("factor", "missing")
)
