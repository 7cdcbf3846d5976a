"""What is known of the lenses: files of Kalibr, OpenCV, ROS, DSEC and RPG.

    Kalibr      YAML: `cam0`, `cam1` ... each with intrinsics, distortion_coeffs, resolution
    DSEC        YAML: the same below `intrinsics`; `extrinsics` has T_10, T_21 ...
    OpenCV      YAML or XML: camera_matrix, distortion_coefficients, image_width, image_height
    ROS         YAML: the same, as mappings with `data`
    RPG         text: fx fy cx cy k1 k2 p1 p2 k3

All of these count pixels from the centre of the first one, and this project from its corner: half
a pixel is added to principal points.

Source: Furgale et al., *Unified temporal and spatial calibration* (IROS 2013), for Kalibr.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError
from sharpfield.recordings.plain_yaml import read_yaml

HALF = 0.5
"""From the centre of the first pixel to its corner."""

ONLY = "camera"
"""Name of the camera in a file of one."""

BROWN = ("radtan", "plumb_bob", "brown", "radial-tangential")
FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
PINHOLE = ("none", "pinhole", "")
SIZE_KEYS = ("image_width", "image_height")

Pose = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Calibration:
    """Cameras by name, and how they stand to each other, where that is known."""

    cameras: dict[str, Camera]
    from_first: dict[str, Pose] = field(default_factory=dict[str, Pose])
    """Takes points from the axes of the first camera to those of this one."""

    def camera(self, name: str | None, where: object) -> tuple[str, Camera]:
        """A camera by name; the only one if there is one.

        Raises:
            CaptureError: There is no such camera, or there are several and none is named.
        """
        if name is None and len(self.cameras) == 1:
            return next(iter(self.cameras.items()))
        if name is not None and name in self.cameras:
            return name, self.cameras[name]
        raise CaptureError(
            "the calibration has several cameras" if name is None else "no such camera",
            where=where,
            got=", ".join(self.cameras) if name is None else name,
            do="name one: " + ", ".join(self.cameras),
        )

    def between(self, name: str, other: str) -> Pose | None:
        """Takes points from the axes of one camera to those of another, if that is known."""
        if not {name, other} <= self.from_first.keys():
            return None
        return self.from_first[other] @ np.linalg.inv(self.from_first[name])


def read_calibration(path: Path, *, size: tuple[int, int] | None = None) -> Calibration:
    """The cameras of a calibration file, recognised by what is in it.

    Args:
        path: The file.
        size: Width and height of the sensor, where the file does not say.

    Raises:
        CaptureError: It is missing, or of no known kind, or a lens model is not known here.
    """
    if not path.is_file():
        raise CaptureError("calibration not found", where=path)
    if path.suffix.lower() == ".xml":
        return Calibration({ONLY: _opencv(_xml(path), size, path)})
    numbers = _numbers(path)
    if numbers is not None:
        return Calibration({ONLY: _rpg(numbers, size, path)})
    found = read_yaml(path)
    held = found.get("intrinsics", found)
    cameras = {
        name: _kalibr(about, f"{path}, {name}", size)
        for name, about in (held.items() if isinstance(held, Mapping) else ())
        if isinstance(about, Mapping)
        and ("intrinsics" in about or isinstance(about.get("camera_matrix"), list))
    }
    if cameras:
        return Calibration(cameras, _chain(found, list(cameras), path))
    if "camera_matrix" in found or "cameraMatrix" in found or "K" in found:
        return Calibration({ONLY: _opencv(found, size, path)})
    raise CaptureError(
        "no calibration of a known kind",
        where=path,
        got=", ".join(found) or "nothing",
        do="give a file of Kalibr, OpenCV, ROS, DSEC, or a text `fx fy cx cy k1 k2 p1 p2 k3`",
    )


def ideal_pixels(camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    """Where each pixel's centre would be without the lens's distortion, in index units.

    10.0 is the centre of ideal pixel 10, as `core.events` has it for rectified events.
    """
    direction = camera.direction(camera.grid().double())
    plane = (direction[..., :2] / direction[..., 2:]).numpy()
    scale = np.array([camera.fx_px, camera.fy_px])
    centre = np.array([camera.cx_px, camera.cy_px]) - HALF
    return (plane * scale + centre).astype(np.float32)


def seen_from(
    ideal: Camera, real: Camera, turn: Float64[np.ndarray, "3 3"] | None = None
) -> Float32[np.ndarray, "h w 2"]:
    """Where each pixel of an ideal camera lies in the image of a real one, for `cv2.remap`.

    Args:
        ideal: The camera whose image is wanted.
        real: The camera that took the image.
        turn: Takes directions from the ideal camera's axes to the real one's; where the two do not
            stand in the same place this holds for far points only.
    """
    direction = ideal.direction(ideal.grid().double())
    if turn is not None:
        direction = direction @ torch.from_numpy(turn).T
    behind = direction[..., 2] <= 0
    xy = real.project(torch.where(behind[..., None], torch.ones_like(direction), direction))
    xy[behind] = -1e4
    return (xy - HALF).float().numpy()


def _kalibr(about: Mapping[str, Any], where: str, size: tuple[int, int] | None) -> Camera:
    intrinsics = _floats(about.get("intrinsics", about.get("camera_matrix")), where, "intrinsics")
    if about.get("camera_model", "pinhole") != "pinhole" or len(intrinsics) != 4:
        raise CaptureError(
            "unknown camera model",
            where=where,
            got=f"{about.get('camera_model')} with {len(intrinsics)} intrinsics",
            do="calibrate with pinhole-radtan or pinhole-equi",
        )
    told = about.get("resolution")
    stated = tuple(int(n) for n in _floats(told, where, "resolution")) if told else None
    return _camera(
        intrinsics,
        str(about.get("distortion_model", "none")),
        _floats(about.get("distortion_coeffs", []), where, "distortion_coeffs"),
        (stated[0], stated[1]) if stated and len(stated) == 2 else size,
        where,
    )


def _opencv(found: Mapping[str, Any], size: tuple[int, int] | None, path: Path) -> Camera:
    def first(*names: str) -> Any:
        return next((found[name] for name in names if name in found), None)

    matrix = _floats(_data(first("camera_matrix", "cameraMatrix", "K")), path, "camera_matrix")
    if len(matrix) != 9:
        raise CaptureError("a camera matrix has nine numbers", where=path, got=len(matrix))
    stored = first("distortion_coefficients", "distCoeffs", "dist_coeffs", "D")
    coefficients = [] if stored is None else _floats(_data(stored), path, "distortion")
    model = str(found.get("distortion_model", "plumb_bob" if coefficients else "none"))
    if found.get("fisheye_model") in (1, True):
        model = "fisheye"
    if all(name in found for name in SIZE_KEYS):
        size = int(found[SIZE_KEYS[0]]), int(found[SIZE_KEYS[1]])
    intrinsics = [matrix[0], matrix[4], matrix[2], matrix[5]]
    return _camera(intrinsics, model, coefficients, size, path)


def _rpg(numbers: list[float], size: tuple[int, int] | None, path: Path) -> Camera:
    return _camera(numbers[:4], "radtan", numbers[4:], size, path)


def _camera(
    intrinsics: Sequence[float],
    model: str,
    coefficients: Sequence[float],
    size: tuple[int, int] | None,
    where: object,
) -> Camera:
    if size is None:
        raise CaptureError(
            "the calibration does not say the size of the image",
            where=where,
            do="give width and height in pixels",
        )
    fx, fy, cx, cy = intrinsics
    lens, distortion = _lens(model.lower(), list(coefficients), where)
    return Camera(*size, fx, fy, cx + HALF, cy + HALF, lens, distortion)


def _lens(model: str, coefficients: list[float], where: object) -> tuple[str, tuple[float, ...]]:
    if not any(coefficients):
        return "pinhole", ()
    if model in BROWN and len(coefficients) >= 4 and not any(coefficients[5:]):
        return "brown", tuple((coefficients + [0.0])[:5])
    if model in FISHEYE and len(coefficients) == 4:
        return "fisheye", tuple(coefficients)
    raise CaptureError(
        "unknown lens model",
        where=where,
        got=f"{model} with {len(coefficients)} coefficients",
        do=f"use one of {', '.join([*BROWN, *FISHEYE, *PINHOLE[:2]])}",
    )


def _chain(found: Mapping[str, Any], names: list[str], path: Path) -> dict[str, Pose]:
    """How each camera stands to the first, from what each says of the one before it."""
    extrinsics = found.get("extrinsics", {})
    known = {names[0]: np.eye(4)}
    for i, name in enumerate(names[1:], start=1):
        about = found.get(name)
        told = about.get("T_cn_cnm1") if isinstance(about, Mapping) else None
        if told is None and isinstance(extrinsics, Mapping):
            told = extrinsics.get(f"T_{i}{i - 1}")
        if told is None or names[i - 1] not in known:
            break
        step = np.array([_floats(row, path, "an extrinsic") for row in told], np.float64)
        if step.shape != (4, 4) or not np.allclose(
            step[:3, :3] @ step[:3, :3].T, np.eye(3), atol=1e-3
        ):
            raise CaptureError("not a rigid motion", where=f"{path}, {name}", got=step.tolist())
        known[name] = step @ known[names[i - 1]]
    return known


def _data(stored: Any) -> Any:
    """The numbers of a matrix: a list, nested or not, or a mapping with `data`."""
    if isinstance(stored, Mapping):
        stored = stored.get("data", [])
    return np.ravel(np.array(stored)).tolist() if isinstance(stored, list) else stored


def _floats(stored: Any, where: object, what: str) -> list[float]:
    if isinstance(stored, Sequence) and not isinstance(stored, str):
        if all(isinstance(value, int | float) and np.isfinite(value) for value in stored):
            return [float(value) for value in stored]
    raise CaptureError(f"{what} must be a list of numbers", where=where, got=str(stored)[:60])


def _numbers(path: Path) -> list[float] | None:
    """The nine (or eight, or four) numbers that a text of RPG is made of."""
    try:
        numbers = [float(word) for word in path.read_text(encoding="utf-8").split()]
    except (ValueError, UnicodeDecodeError):
        return None
    return numbers if len(numbers) in (4, 8, 9) else None


def _xml(path: Path) -> dict[str, Any]:
    storage = cv2.FileStorage()
    try:
        if not storage.open(str(path), cv2.FILE_STORAGE_READ):
            raise CaptureError("cannot read the calibration", where=path)
        root = storage.root()
        return {name: _node(root.getNode(name)) for name in root.keys()}
    except cv2.error as error:
        raise CaptureError("cannot read the calibration", where=path, got=error) from None
    finally:
        storage.release()


def _node(node: cv2.FileNode) -> Any:
    if node.isMap():
        matrix = node.mat()
        return None if matrix is None else matrix.tolist()
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None
