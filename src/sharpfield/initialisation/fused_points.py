"""Depth fusion: a point cloud from the depth maps of many frames, one point for each voxel.

The points of all pixels that fall into a voxel are averaged: position, colour, normal. Only
training frames are fused by default: a method should not have the depth of held-out frames.

Source: Hybrid Neural Rendering (CVPR 2023) starts from such points; its release fuses the depth of
all frames, held-out ones included (`frames="all"`), in voxels of about 1 cm.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError

MAX_PENDING = 3_000_000
"""Voxels of single frames that are collected before they are merged; bounds memory. As many as are
merged already may be collected, so that time grows with the frames and not with their square."""

BITS = 21
"""Bits of each coordinate in the key of a voxel: 2 million voxels along each axis."""

EDGE = 0.1
"""Relative change of depth between neighbours from which on there is an edge and no surface."""


@dataclass(frozen=True)
class FusedPoints:
    """Points of surfaces, in the world of the capture they come from."""

    points: Float32[np.ndarray, "p 3"]
    colours: Float32[np.ndarray, "p 3"]
    """As frames store them, 0...1; grey frames give three equal values."""
    normals: Float32[np.ndarray, "p 3"]
    """Unit length, towards the cameras that saw the point; zero at edges."""
    views: Int64[np.ndarray, "p"]
    """How many frames saw the voxel."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)


@dataclass(frozen=True)
class _Sums:
    """Sums over the pixels in each voxel."""

    keys: Int64[np.ndarray, "v"]
    """Keys of voxels, ascending."""
    columns: Float64[np.ndarray, "11 v"]
    """Summed position (3), weighted colour (3), normal (3), weight, count."""

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self.keys)


@dataclass(frozen=True)
class _DepthPixels:
    """Rays of the pixels of a depth map, and the pixels of a frame on the same rays."""

    rays: Float32[np.ndarray, "h w 3"]
    """With a z of 1."""
    row: Int64[np.ndarray, "h w"]
    column: Int64[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]
    """Whether there is such a pixel."""


def fuse_points(
    capture: Capture,
    *,
    frames: Literal["train", "all"] = "train",
    stride: int = 2,
    voxel: float = 0.01,
    min_depth: float = 0.0,
    max_depth: float = np.inf,
    weight: Float64[np.ndarray, "n"] | None = None,
) -> FusedPoints:
    """Fuse the depth maps of a capture.

    Args:
        capture: With frames and depth.
        frames: "train", or "all": as published, but it leaks the depth of held-out frames.
        stride: Use every how many pixels of a map, along both axes.
        voxel: Edge of a voxel, in world units.
        min_depth: Smaller depth is left out; published work has 0.3 m.
        max_depth: Larger depth is left out; published work has 8 m.
        weight: How much each frame counts for the colours, e.g. its sharpness; of all frames.

    Raises:
        CaptureError: There is no depth, or none within the limits.
        OptionError: Stride or voxel is not positive.
    """
    if stride < 1 or not voxel > 0:
        raise OptionError("stride and voxel must be positive", got=f"{stride}, {voxel}")
    depth, pixels = capture.needed_depth, _depth_pixels(capture, stride)
    chosen = capture.split.train if frames == "train" else np.arange(len(depth))
    poses = capture.frame_pose(chosen).detach().double().numpy()
    origin = poses[:, :, 3].mean(0) if len(poses) else np.zeros(3)
    known, seen = _merged([]), []
    for frame, pose in zip(chosen.tolist(), poses, strict=True):
        share = 1.0 if weight is None else float(weight[frame])
        measured = depth.at(frame)[::stride, ::stride]
        valid = (measured > max(min_depth, 0)) & (measured < max_depth)
        columns = _seen(capture, frame, pixels, np.where(valid, measured, 0), pose, share)
        keys = _voxel_keys(columns[:3].T - origin, voxel, capture.name)
        seen.append(_summed(keys, columns))
        if sum(map(len, seen)) > max(MAX_PENDING, len(known)):
            known, seen = _merged([known, *seen]), []
    known = _merged([known, *seen])
    if not len(known):
        raise CaptureError(
            "the depth maps hold no points",
            where=capture.name,
            got=f"{len(chosen)} frames, depth {min_depth} to {max_depth}",
        )
    return _points(known.columns)


def _depth_pixels(capture: Capture, stride: int) -> _DepthPixels:
    """The same for all frames, since both cameras have the same centre."""
    rays = np.ascontiguousarray(capture.needed_depth.rays()[::stride, ::stride])
    xy = capture.camera.project(torch.from_numpy(rays.astype(np.float64))).numpy()
    column, row = np.moveaxis(np.floor(xy).astype(np.int64), -1, 0)
    width, height = capture.camera.size
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return _DepthPixels(rays, row, column, inside)


def _seen(
    capture: Capture,
    frame: int,
    pixels: _DepthPixels,
    depth: Float32[np.ndarray, "h w"],
    pose: Float64[np.ndarray, "3 4"],
    share: float,
) -> Float64[np.ndarray, "11 q"]:
    """The columns of `_Sums` for each pixel of one frame."""
    frames, inside = capture.needed_frames, pixels.rays * depth[..., None]
    held = (depth > 0) & pixels.inside
    colour = np.asarray(frames.images[frame])[pixels.row[held], pixels.column[held]]
    columns = np.ones((11, len(colour)))
    columns[:3] = pose[:, :3] @ inside[held].T + pose[:, 3:]
    columns[3:6] = colour.T * (share / frames.white)
    columns[6:9] = pose[:, :3] @ _normals(inside, depth)[held].T
    columns[9] = share
    return columns


def _normals(
    inside: Float32[np.ndarray, "h w 3"], depth: Float32[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w 3"]:
    """Unit normals towards the camera, from neighbours to the right and below; zero at edges."""
    normals = np.zeros(inside.shape, np.float64)
    here = inside[:-1, :-1].astype(np.float64)
    right, down = inside[:-1, 1:] - here, inside[1:, :-1] - here
    across = np.cross(down, right)
    length = np.linalg.norm(across, axis=-1)
    near = depth[:-1, :-1]
    smooth = (near > 0) & (length > 0)
    for other in (depth[:-1, 1:], depth[1:, :-1]):
        smooth &= (other > 0) & (np.abs(other - near) < EDGE * near)
    unit = across / np.where(length > 0, length, 1)[..., None]
    away = (unit * here).sum(-1, keepdims=True) > 0
    normals[:-1, :-1] = np.where(smooth[..., None], np.where(away, -unit, unit), 0)
    return normals


def _voxel_keys(
    points: Float64[np.ndarray, "q 3"], voxel: float, where: str
) -> Int64[np.ndarray, "q"]:
    """The key of the voxel that each point is in."""
    cell = np.floor(points / voxel).astype(np.int64) + (1 << (BITS - 1))
    if len(cell) and (cell.min() < 0 or cell.max() >= 1 << BITS):
        raise CaptureError(
            "points are too far apart for voxels of this size",
            where=where,
            got=f"{np.abs(points).max():.3g} from the cameras, voxel {voxel}",
            do="give `max_depth`, or a larger voxel",
        )
    return (cell[:, 0] << 2 * BITS) | (cell[:, 1] << BITS) | cell[:, 2]


def _summed(keys: Int64[np.ndarray, "q"], columns: Float64[np.ndarray, "11 q"]) -> _Sums:
    """Means over the pixels of one frame in each voxel; together they count as one view."""
    sums = _merged([_Sums(keys, columns)])
    return _Sums(sums.keys, sums.columns / sums.columns[10])


def _merged(seen: list[_Sums]) -> _Sums:
    """One entry for each voxel, summed over all that have it; ascending."""
    if not seen:
        return _Sums(np.zeros(0, np.int64), np.zeros((11, 0)))
    keys = np.concatenate([one.keys for one in seen])
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.diff(keys, prepend=keys[:1] - 1) != 0
    number = np.cumsum(first) - 1
    sums = np.empty((11, int(first.sum())))
    for i, row in enumerate(sums):  # one after the other: all of them sorted would be many
        values = np.concatenate([one.columns[i] for one in seen])[order]
        row[:] = np.bincount(number, values, len(row))
    return _Sums(keys[first], sums)


def _points(sums: Float64[np.ndarray, "11 v"]) -> FusedPoints:
    """Means of what `_Sums` sums."""
    weight, views = sums[9], sums[10]
    length = np.linalg.norm(sums[6:9], axis=0)
    return FusedPoints(
        points=(sums[:3] / views).T.astype(np.float32, order="C"),
        colours=(sums[3:6] / np.where(weight > 0, weight, 1)).T.astype(np.float32, order="C"),
        normals=(sums[6:9] / np.where(length > 0, length, 1)).T.astype(np.float32, order="C"),
        views=np.rint(views).astype(np.int64),
    )
