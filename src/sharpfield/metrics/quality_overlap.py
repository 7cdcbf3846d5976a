"""Overlap of two images: pixels of the same point, by depth and poses, or by optical flow."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from sharpfield.core.capture import Capture

EVERY = 4
"""Stride of the pixels that are used, along both axes."""
BORDER = 20 / 640
"""Margin that is left out at each border, as a fraction of the width."""
SAME_DEPTH = 0.05
"""Depths with a smaller relative difference are of the same surface."""
FLOW_SHRINK = 2
"""Factor by which images are downscaled for optical flow."""


@dataclass(frozen=True)
class Overlap:
    """Pixels of one image, and the corresponding pixels of another."""

    here: Int64[np.ndarray, "q 2"]
    """Rows and columns."""
    there: Int64[np.ndarray, "q 2"]
    share: float
    """Fraction of the sampled pixels that are visible in both."""


def depth_overlap(capture: Capture, first: int, second: int, size: tuple[int, int]) -> Overlap:
    """Overlap of two frames, by depth and poses; occluded points do not count.

    Args:
        capture: With depth.
        first: The frame whose pixels are projected.
        second: The frame to which they are projected.
        size: Width and height of the images to compare, of the same field of view.
    """
    camera, depth = capture.camera, capture.needed_depth
    here = _lattice(size)
    scale = np.array([camera.width / size[0], camera.height / size[1]])
    xy = torch.from_numpy((here[:, ::-1] + 0.5) * scale)
    rays = camera.direction(xy)
    rays = rays / rays[:, 2:]
    measured = _looked_up(depth.at(first), depth.camera.project(rays).numpy())
    poses = capture.frame_pose(np.array([first, second])).detach().double().numpy()
    points = (rays.numpy() * measured[:, None]) @ poses[0, :, :3].T + poses[0, :, 3]
    inside = (points - poses[1, :, 3]) @ poses[1, :, :3]
    ahead = np.where(inside[:, 2:] > 0, inside, [0, 0, 1])
    seen = torch.from_numpy(ahead)
    there = np.floor(camera.project(seen).numpy() / scale)[:, ::-1].astype(np.int64)
    other = _looked_up(depth.at(second), depth.camera.project(seen).numpy())
    good = (measured > 0) & (inside[:, 2] > 0)
    good &= np.abs(other - inside[:, 2]) < SAME_DEPTH * inside[:, 2]
    return _kept(here, there, good, size)


def flow_overlap(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> Overlap:
    """Overlap of two grey images, by dense optical flow (DIS).

    Source: Kroeger et al., "Fast optical flow using dense inverse search" (ECCV 2016).
    """
    height, width = first.shape
    small = width // FLOW_SHRINK, height // FLOW_SHRINK
    find = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    one, other = (cv2.resize(p, small, interpolation=cv2.INTER_AREA) for p in (first, second))
    flow = find.calc(one, other, np.zeros((*one.shape, 2), np.float32))
    here = _lattice((width, height))
    at = np.minimum(here // FLOW_SHRINK, np.array(small)[::-1] - 1)
    shift = flow[at[:, 0], at[:, 1]] * np.array([width / small[0], height / small[1]])
    there = np.floor(here + 0.5 + shift[:, ::-1]).astype(np.int64)
    return _kept(here, there, np.ones(len(here), bool), (width, height))


def _lattice(size: tuple[int, int]) -> Int64[np.ndarray, "q 2"]:
    """Rows and columns of every `EVERY`-th pixel."""
    rows, columns = (np.arange(EVERY // 2, side, EVERY) for side in size[::-1])
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2).astype(np.int64)


def _kept(
    here: Int64[np.ndarray, "q 2"],
    there: Int64[np.ndarray, "q 2"],
    good: np.ndarray,
    size: tuple[int, int],
) -> Overlap:
    """Pairs away from the borders of both images."""
    border = round(BORDER * size[0])
    least, most = border, np.array(size)[::-1] - border
    for pixel in (here, there):
        good = good & ((pixel >= least) & (pixel < most)).all(1)
    return Overlap(here[good], there[good], float(good.mean()))


def _looked_up(
    depth: Float32[np.ndarray, "h w"], xy: Float64[np.ndarray, "q 2"]
) -> Float64[np.ndarray, "q"]:
    """Depth at the nearest pixel; 0 outside."""
    column, row = np.floor(np.clip(xy, -1, 1e6)).astype(np.int64).T
    height, width = depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.where(inside, found, 0.0).astype(np.float64)
