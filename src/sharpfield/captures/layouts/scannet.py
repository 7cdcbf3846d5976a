"""ScanNet scenes, and other data in their layout (such as Habitat renders).

    color/0.jpg, ...           RGB; or in `rgb/`, or PNG
    depth/0.png, ...           16 bit, millimetres, 0 where unknown; its size differs from colour
    pose/0.txt, ...            4x4, world-from-camera; -inf, or no file, where tracking failed
    intrinsic/intrinsic_color.txt, intrinsic_depth.txt     4x4
    truth/0.png, truth/blur_px.txt    our extension: sharp frames and true blur of simulations
    SCENE_vh_clean.ply         optional, beside `exported/`: vertices of the reconstructed mesh

The files lie in the scene's folder or in `exported/` there. Colour images larger than 640x480 are
downscaled to that size, and one frame in five is for training, as published by Point-NeRF and
Hybrid Neural Rendering.

Source: Dai et al., *ScanNet* (CVPR 2017).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._rgbd import (
    RgbdFrames,
    pinhole,
    read_matrix,
    read_pose,
    read_rgb,
    rgbd_capture,
    usable_poses,
)
from sharpfield.captures.native.frames import decode_depth
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.storage.images import SUFFIXES, image_stack, read_image
from sharpfield.storage.ply import columns, read_ply

COLOUR, DEPTH, POSE, TRUTH = ("color", "rgb"), "depth", "pose", "truth"
BLUR = "blur_px.txt"
INTRINSIC_COLOUR = Path("intrinsic") / "intrinsic_color.txt"
INTRINSIC_DEPTH = Path("intrinsic") / "intrinsic_depth.txt"


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout, itself or in `exported/`."""
    inner = _inner(folder)
    return (inner / POSE).is_dir() and (inner / INTRINSIC_COLOUR).is_file() and bool(_colour(inner))


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene.

    Args:
        folder: Holds what the module describes.
        options: `hold_out`.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    inner = _inner(folder)
    colour = _colour(inner)
    names = [path.stem for path in colour]
    first = read_image(colour[0])
    maps = [inner / DEPTH / f"{name}.png" for name in names]
    measured = np.array([path.is_file() for path in maps])
    camera = pinhole(
        read_matrix(inner / INTRINSIC_COLOUR), first.shape[1::-1], where=inner / INTRINSIC_COLOUR
    )
    frames = RgbdFrames(
        names=names,
        poses=np.stack([_pose(inner / POSE / f"{name}.txt") for name in names]),
        colour=lambda row: read_rgb(colour[row]),
        depth=lambda row: decode_depth(maps[row]),
        measured=measured,
        camera=camera,
        depth_camera=_depth_camera(inner, maps[int(np.argmax(measured))]) or camera,
        sources=colour,
        depth_sources=[path for path, known in zip(maps, measured, strict=True) if known],
    )
    made = rgbd_capture(
        frames, options.hold_out, folder=folder, source="scannet", points=_mesh(folder)
    )
    return _with_truth(made, inner, np.flatnonzero(usable_poses(frames.poses)))


def by_number(folder: Path) -> list[Path]:
    """Images of a folder, in the order of the numbers in their names."""
    found = [path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES]
    return sorted(found, key=lambda p: (int("".join(filter(str.isdigit, p.stem)) or -1), p))


def _inner(folder: Path) -> Path:
    return folder / "exported" if (folder / "exported").is_dir() else folder


def _colour(inner: Path) -> list[Path]:
    return next(filter(None, (by_number(inner / name) for name in COLOUR)), [])


def _pose(path: Path) -> Float64[np.ndarray, "3 4"]:
    return read_pose(path) if path.is_file() else np.full((3, 4), np.nan)


def _depth_camera(inner: Path, path: Path) -> Camera | None:
    """The camera of a depth map; None if the map does not exist."""
    if not path.is_file():
        return None
    matrix = read_matrix(inner / INTRINSIC_DEPTH)
    return pinhole(matrix, decode_depth(path).shape[::-1], where=inner / INTRINSIC_DEPTH)


def _mesh(folder: Path) -> Float64[np.ndarray, "m 3"] | None:
    for path in sorted(folder.glob("*_vh_clean.ply")):
        return columns(read_ply(path), ("x", "y", "z"), where=path).astype(np.float64)
    return None


def _with_truth(capture: Capture, inner: Path, kept: Int64[np.ndarray, "n"]) -> Capture:
    """The capture with the sharp frames and the true blur that a simulation wrote."""
    frames = capture.needed_frames
    paths = [inner / TRUTH / f"{name}.png" for name in frames.names]
    known = np.array([path.is_file() for path in paths])
    if known.any():
        unknown = np.zeros(frames.images.shape[1:], np.uint8)
        truth = image_stack(
            paths,
            lambda path: read_rgb(path) if path.is_file() else unknown,
            sources=[path for path in paths if path.is_file()],
            kind="truth",
        )
        frames = replace(frames, truth=truth, truth_known=known)
    if (inner / TRUTH / BLUR).is_file():
        frames = replace(frames, blur_px=read_matrix(inner / TRUTH / BLUR)[kept, 0])
    return replace(capture, frames=frames)


LAYOUT = Layout("scannet", recognise, read, "color/, pose/ and intrinsic/intrinsic_color.txt")
