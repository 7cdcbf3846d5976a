"""Camera calibrations: files of Kalibr, OpenCV, ROS, DSEC and RPG.

    Kalibr      YAML: `cam0`, `cam1` ... each with intrinsics, distortion_coeffs, resolution
    DSEC        YAML: the same below `intrinsics`; `extrinsics` has T_10, T_21 ...
    OpenCV      YAML or XML: camera_matrix, distortion_coefficients, image_width, image_height
    ROS         YAML: the same, as mappings with `data`
    RPG         text: fx fy cx cy k1 k2 p1 p2 k3

All of these put the origin of pixel coordinates at the centre of the first pixel, this project at
its corner: half a pixel is added to principal points.

YAML is read without anchors, aliases and types named by tags, so that a file can neither run code
nor expand beyond its size.

Source: Furgale et al., *Unified temporal and spatial calibration* (IROS 2013), for Kalibr.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
import yaml
from jaxtyping import Float32, Float64
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError
from sharpfield.core.lenses import LENSES, lens_in_calibration

HALF_PIXEL = 0.5
"""From the centre of the first pixel to its corner."""

SINGLE_CAMERA = "camera"
"""Name of the camera in a file of only one."""

MAX_BYTES, MAX_NESTING = 1 << 20, 32
"""Limits of a YAML file: a calibration is a page or two."""

SIZE_KEYS = ("image_width", "image_height")

Pose = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Calibration:
    """Cameras by name, and their relative poses where the file gives them."""

    cameras: dict[str, Camera]
    camera_from_first: dict[str, Pose] = field(default_factory=dict[str, Pose])
    """Transforms points from the axes of the first camera to those of each camera."""

    def camera(self, name: str | None, where: object) -> tuple[str, Camera]:
        """A camera by name; without a name, the only one.

        Raises:
            CaptureError: There is no such camera, or there are several and no name was given.
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

    def other_from_camera(self, name: str, other: str) -> Pose | None:
        """Transform from the axes of one camera to those of another; None if it is unknown."""
        if not {name, other} <= self.camera_from_first.keys():
            return None
        return self.camera_from_first[other] @ np.linalg.inv(self.camera_from_first[name])


def read_calibration(path: Path, *, size: tuple[int, int] | None = None) -> Calibration:
    """Read the cameras of a calibration file; its content decides which program wrote it.

    Args:
        path: The file.
        size: Sensor resolution, width and height, where the file does not give it.

    Raises:
        CaptureError: The file is missing or of no known kind, or its lens model is not supported.
    """
    if not path.is_file():
        raise CaptureError("calibration not found", where=path)
    if path.suffix.lower() == ".xml":
        return Calibration({SINGLE_CAMERA: _opencv(_xml(path), size, path)})
    numbers = _numbers(path)
    if numbers is not None:
        return Calibration({SINGLE_CAMERA: _rpg(numbers, size, path)})
    content = read_yaml(path)
    entries = content.get("intrinsics", content)
    cameras = {
        name: _kalibr(entry, f"{path}, {name}", size)
        for name, entry in (entries.items() if isinstance(entries, Mapping) else ())
        if isinstance(entry, Mapping)
        and ("intrinsics" in entry or isinstance(entry.get("camera_matrix"), list))
    }
    if cameras:
        return Calibration(cameras, _extrinsics(content, list(cameras), path))
    if "camera_matrix" in content or "cameraMatrix" in content or "K" in content:
        return Calibration({SINGLE_CAMERA: _opencv(content, size, path)})
    raise CaptureError(
        "no calibration of a known kind",
        where=path,
        got=", ".join(content) or "nothing",
        do="give a file of Kalibr, OpenCV, ROS, DSEC, or a text `fx fy cx cy k1 k2 p1 p2 k3`",
    )


def undistorted_pixels(camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    """Position of each pixel centre in the image of an ideal pinhole camera, in index units.

    10.0 is the centre of undistorted pixel 10, as `core.events` has it for rectified events.
    """
    direction = camera.direction(camera.grid().double())  # [h w 3]
    plane = (direction[..., :2] / direction[..., 2:]).numpy()  # [h w 2]
    scale = np.array([camera.fx_px, camera.fy_px])
    centre = np.array([camera.cx_px, camera.cy_px]) - HALF_PIXEL
    return (plane * scale + centre).astype(np.float32)


def resampling_map(
    ideal: Camera, real: Camera, real_from_ideal: Float64[np.ndarray, "3 3"] | None = None
) -> Float32[np.ndarray, "h w 2"]:
    """Position of each pixel of an ideal camera in the image of a real one, for `cv2.remap`.

    Args:
        ideal: The camera whose image is wanted.
        real: The camera that took the image.
        real_from_ideal: Rotation of directions from the ideal camera's axes to the real one's.
            Where the cameras have different centres, this is exact for points at infinity only.
    """
    direction = ideal.direction(ideal.grid().double())  # [h w 3]
    if real_from_ideal is not None:
        direction = direction @ torch.from_numpy(real_from_ideal).T
    behind = direction[..., 2] <= 0  # [h w]
    xy = real.project(torch.where(behind[..., None], torch.ones_like(direction), direction))
    xy[behind] = -1e4
    return (xy - HALF_PIXEL).float().numpy()


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping with text keys.

    Raises:
        CaptureError: The file is missing, too large, no mapping, or not such YAML.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CaptureError("too large for a calibration", where=path)
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except UnicodeDecodeError as error:
        raise CaptureError("not a text", where=path, got=error) from None
    # OpenCV writes the directive with a colon, and some programs indent with tabs.
    text = text.replace("%YAML:", "%YAML ", 1).replace("\t", "    ")
    found, line, problem = None, 1, "no mapping"
    try:
        found = yaml.load(text, _CalibrationLoader)
        if found is None:
            return {}
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = 1 if mark is None else mark.line + 1
        problem = getattr(error, "problem", None) or error
    if isinstance(found, dict):
        return found
    raise CaptureError(
        "cannot read this YAML",
        where=f"{path}, line {line}",
        got=problem,
        do="write plain mappings, lists and numbers, as Kalibr and OpenCV do",
    )


class _CalibrationLoader(yaml.SafeLoader):
    """YAML without anchors, aliases, dates and base-60 numbers; keys are distinct texts.

    Tags, such as OpenCV's `!!opencv-matrix`, change nothing: there is no constructor for any.
    """

    yaml_implicit_resolvers, yaml_constructors, _nesting = {}, {}, 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()
        if getattr(event, "anchor", None) is not None:
            raise ComposerError(None, None, "an anchor or alias", event.start_mark)
        self._nesting += 1
        if self._nesting > MAX_NESTING:
            raise ComposerError(None, None, "nested too deeply", event.start_mark)
        node = super().compose_node(parent, index)
        self._nesting -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[str, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(keys)) != len(node.value):
            raise ConstructorError(None, None, "a key that is repeated or no text", node.start_mark)
        values = (self.construct_object(value, deep=True) for _, value in node.value)
        return dict(zip(keys, values, strict=True))


_TAG = "tag:yaml.org,2002:"
_PLAIN_VALUES: dict[str, tuple[str, Callable[[str], Any]]] = {
    "null": ("~|null|Null|NULL|", lambda text: None),
    "bool": ("true|True|TRUE|false|False|FALSE", lambda text: text.lower() == "true"),
    "int": ("[-+]?[0-9]{1,18}", int),
    "float": (r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?", float),
}
"""Pattern and conversion of what is no text, although it has no quotes."""

for _name, (_pattern, _convert) in _PLAIN_VALUES.items():
    _CalibrationLoader.add_implicit_resolver(_TAG + _name, re.compile(rf"({_pattern})\Z"), None)
    _CalibrationLoader.add_constructor(
        _TAG + _name, lambda loader, node, of=_convert: of(loader.construct_scalar(cast(Any, node)))
    )


def _kalibr(entry: Mapping[str, Any], where: str, size: tuple[int, int] | None) -> Camera:
    intrinsics = _floats(entry.get("intrinsics", entry.get("camera_matrix")), where, "intrinsics")
    if entry.get("camera_model", "pinhole") != "pinhole" or len(intrinsics) != 4:
        raise CaptureError(
            "unknown camera model",
            where=where,
            got=f"{entry.get('camera_model')} with {len(intrinsics)} intrinsics",
            do="calibrate with pinhole-radtan or pinhole-equi",
        )
    stored = entry.get("resolution")
    stated = tuple(int(n) for n in _floats(stored, where, "resolution")) if stored else None
    return _camera(
        intrinsics,
        str(entry.get("distortion_model", "none")),
        _floats(entry.get("distortion_coeffs", []), where, "distortion_coeffs"),
        (stated[0], stated[1]) if stated and len(stated) == 2 else size,
        where,
    )


def _opencv(content: Mapping[str, Any], size: tuple[int, int] | None, path: Path) -> Camera:
    def first(*names: str) -> Any:
        return next((content[name] for name in names if name in content), None)

    matrix = _floats(_flat(first("camera_matrix", "cameraMatrix", "K")), path, "camera_matrix")
    if len(matrix) != 9:
        raise CaptureError("a camera matrix has nine numbers", where=path, got=len(matrix))
    stored = first("distortion_coefficients", "distCoeffs", "dist_coeffs", "D")
    coefficients = [] if stored is None else _floats(_flat(stored), path, "distortion")
    model = str(content.get("distortion_model", "plumb_bob" if coefficients else "none"))
    if content.get("fisheye_model") in (1, True):
        model = "fisheye"
    if all(name in content for name in SIZE_KEYS):
        size = int(content[SIZE_KEYS[0]]), int(content[SIZE_KEYS[1]])
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
            "the calibration does not give the image size",
            where=where,
            do="give the sensor resolution, WIDTHxHEIGHT",
        )
    fx, fy, cx, cy = intrinsics
    lens, distortion = _lens(model.lower(), list(coefficients), where)
    return Camera(*size, fx, fy, cx + HALF_PIXEL, cy + HALF_PIXEL, lens, distortion)


def _lens(model: str, coefficients: list[float], where: object) -> tuple[str, tuple[float, ...]]:
    if not any(coefficients):
        return "pinhole", ()
    lens = lens_in_calibration(model)
    count = len(lens.coefficients) if lens else 0
    if lens and lens.fewest <= len(coefficients) and not any(coefficients[count:]):
        return lens.name, lens.padded(coefficients[:count])
    names = [name for lens in LENSES.working().values() for name in lens.calibration_names]
    raise CaptureError(
        "unknown lens model",
        where=where,
        got=f"{model} with {len(coefficients)} coefficients",
        do=f"use one of {', '.join(name for name in names if name)}",
    )


def _extrinsics(content: Mapping[str, Any], names: list[str], path: Path) -> dict[str, Pose]:
    """Pose of each camera, chained from the transforms between consecutive cameras."""
    extrinsics = content.get("extrinsics", {})
    camera_from_first = {names[0]: np.eye(4)}
    for i, name in enumerate(names[1:], start=1):
        entry = content.get(name)
        stored = entry.get("T_cn_cnm1") if isinstance(entry, Mapping) else None
        if stored is None and isinstance(extrinsics, Mapping):
            stored = extrinsics.get(f"T_{i}{i - 1}")
        if stored is None or names[i - 1] not in camera_from_first:
            break
        step = np.array([_floats(row, path, "an extrinsic") for row in stored], np.float64)
        if step.shape != (4, 4) or not np.allclose(
            step[:3, :3] @ step[:3, :3].T, np.eye(3), atol=1e-3
        ):
            raise CaptureError("not a rigid motion", where=f"{path}, {name}", got=step.tolist())
        camera_from_first[name] = step @ camera_from_first[names[i - 1]]
    return camera_from_first


def _flat(stored: Any) -> Any:
    """Numbers of a matrix that is stored as a list, nested or not, or as a mapping with `data`."""
    if isinstance(stored, Mapping):
        stored = stored.get("data", [])
    return np.ravel(np.array(stored)).tolist() if isinstance(stored, list) else stored


def _floats(stored: Any, where: object, what: str) -> list[float]:
    if isinstance(stored, Sequence) and not isinstance(stored, str):
        if all(isinstance(value, int | float) and np.isfinite(value) for value in stored):
            return [float(value) for value in stored]
    raise CaptureError(f"{what} must be a list of numbers", where=where, got=str(stored)[:60])


def _numbers(path: Path) -> list[float] | None:
    """The 9 (or 8, or 4) numbers of RPG's calib.txt; None if it is another file."""
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
