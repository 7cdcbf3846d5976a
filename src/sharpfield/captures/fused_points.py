"""A cloud of points from measured depth: one point for each small cube (*voxel*) that was seen.

Pixels of many frames fall into one voxel, and their means become its point: place, colour, normal.
Only frames that are learned from count, unless told: the depth of a held-out frame is knowledge
that a method should not have.

Source: Hybrid Neural Rendering (CVPR 2023) starts from such points; its release fuses the depth of
all frames, held-out ones included (`frames="all"`), in voxels of about 1 cm.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.depth import DepthMaps
from sharpfield.core.errors import CaptureError, OptionError

PENDING = 3_000_000
"""Voxels of single frames that are gathered before they are merged; bounds memory."""

BITS = 21
"""Of each coordinate in the number of a voxel: 2 million voxels along each axis."""

STEEP = 0.1
"""Where depth changes by more than this share between neighbours, there is an edge, no surface."""

Which = Literal["train", "all"]
"""Whose depth to fuse: of frames that are learned from, or of held-out ones, too."""


@dataclass(frozen=True)
class FusedPoints:
    """Points of surfaces, in the world of the capture they come from."""

    points: Float32[np.ndarray, "p 3"]
    colours: Float32[np.ndarray, "p 3"]
    """As frames store them, 0...1; grey frames give three equal values."""
    normals: Float32[np.ndarray, "p 3"]
    """Unit length, towards the cameras that saw the point; zero where only edges were seen."""
    views: Int64[np.ndarray, "p"]
    """How many frames saw the voxel: the more, the surer the point."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)


@dataclass(frozen=True)
class _Sums:
    """What fell into each voxel."""

    keys: Int64[np.ndarray, "v"]
    """Numbers of voxels, ascending."""
    columns: Float64[np.ndarray, "v 11"]
    """Summed place (3), weighted colour (3), normal (3), weight, count."""


def fuse_points(
    capture: Capture,
    *,
    frames: Which = "train",
    stride: int = 2,
    voxel: float = 0.01,
    nearest: float = 0.0,
    farthest: float = np.inf,
    weight: Float64[np.ndarray, "n"] | None = None,
) -> FusedPoints:
    """The points that the depth maps of a capture show.

    Args:
        capture: With frames and depth.
        frames: "train", or "all": as published, but it leaks the depth of held-out frames.
        stride: Take every how many pixels of a map, along both axes.
        voxel: Edge of a voxel, in world units.
        nearest: Smaller depth is left out; published work takes 0.3 m.
        farthest: Larger depth is left out; published work takes 8 m.
        weight: How much each frame counts for the colours, e.g. its sharpness; of all frames.

    Raises:
        CaptureError: There is no depth, or it shows nothing.
        OptionError: Stride or voxel is not positive.
    """
    if stride < 1 or not voxel > 0:
        raise OptionError("stride and voxel must be positive", got=f"{stride}, {voxel}")
    depth = capture.needed_depth
    chosen = capture.split.train if frames == "train" else np.arange(len(depth))
    rays = np.ascontiguousarray(depth.rays()[::stride, ::stride])
    poses = capture.frame_pose(chosen).detach().double().numpy()
    origin = poses[:, :, 3].mean(0) if len(poses) else np.zeros(3)
    seen: list[_Sums] = []
    for frame, pose in zip(chosen.tolist(), poses, strict=True):
        share = 1.0 if weight is None else float(weight[frame])
        measured = depth.at(frame)[::stride, ::stride]
        valid = (measured > max(nearest, 0)) & (measured < farthest)
        columns, places = _seen(capture, frame, rays, np.where(valid, measured, 0), pose, share)
        if len(places):
            seen.append(_summed(_voxels(places - origin, voxel, capture.name), columns))
        if sum(len(one.keys) for one in seen) > PENDING:
            seen = [_merged(seen)]
    if not seen:
        raise CaptureError(
            "the depth maps show no points",
            where=capture.name,
            got=f"{len(chosen)} frames, depth {nearest} to {farthest}",
        )
    return _points(_merged(seen).columns)


def as_points(
    depth: DepthMaps, frame: int, pose: Float64[np.ndarray, "3 4"]
) -> Float64[np.ndarray, "h w 3"]:
    """Where in the world each pixel of a depth map is; NaN where it is unknown.

    Args:
        depth: The maps.
        frame: Which of them.
        pose: World-from-camera of that frame.
    """
    measured = depth.at(frame)
    points = (depth.rays() * measured[..., None]) @ pose[:, :3].T + pose[:, 3]
    return np.where(measured[..., None] > 0, points, np.nan)


def _seen(
    capture: Capture,
    frame: int,
    rays: Float32[np.ndarray, "h w 3"],
    depth: Float32[np.ndarray, "h w"],
    pose: Float64[np.ndarray, "3 4"],
    share: float,
) -> tuple[Float64[np.ndarray, "q 11"], Float64[np.ndarray, "q 3"]]:
    """What one frame saw, a row of the columns of `_Sums` for each pixel; and where."""
    inside = rays * depth[..., None]
    normals = _normals(inside, depth)
    known = depth > 0
    inside, normals = inside[known].astype(np.float64), normals[known]
    image = capture.needed_frames.images[frame]
    xy = capture.camera.project(torch.from_numpy(inside)).numpy()
    column, row = np.floor(xy).astype(np.int64).T
    held = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    white = capture.needed_frames.white
    colour = np.asarray(image)[row[held], column[held]].astype(np.float64) / white
    places = inside[held] @ pose[:, :3].T + pose[:, 3]
    count = len(places)
    rgb = np.broadcast_to(colour, (count, 3)) * share
    turned = normals[held] @ pose[:, :3].T
    return np.hstack([places, rgb, turned, np.full((count, 1), share), np.ones((count, 1))]), places


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
        smooth &= (other > 0) & (np.abs(other - near) < STEEP * near)
    unit = across / np.where(length > 0, length, 1)[..., None]
    away = (unit * here).sum(-1, keepdims=True) > 0
    normals[:-1, :-1] = np.where(smooth[..., None], np.where(away, -unit, unit), 0)
    return normals


def _voxels(places: Float64[np.ndarray, "q 3"], voxel: float, where: str) -> Int64[np.ndarray, "q"]:
    """One number for the voxel that each place is in."""
    cell = np.floor(places / voxel).astype(np.int64) + (1 << (BITS - 1))
    if len(cell) and (cell.min() < 0 or cell.max() >= 1 << BITS):
        raise CaptureError(
            "points are too far apart for voxels of this size",
            where=where,
            got=f"{np.abs(places).max():.3g} from the cameras, voxel {voxel}",
            do="give `farthest`, or a larger voxel",
        )
    return (cell[:, 0] << 2 * BITS) | (cell[:, 1] << BITS) | cell[:, 2]


def _summed(keys: Int64[np.ndarray, "q"], columns: Float64[np.ndarray, "q 11"]) -> _Sums:
    """Means over the pixels of one frame in each voxel: together they count as one view."""
    sums = _gathered(keys, columns)
    return _Sums(sums.keys, sums.columns / sums.columns[:, 10:])


def _merged(seen: list[_Sums]) -> _Sums:
    return _gathered(
        np.concatenate([one.keys for one in seen]), np.concatenate([one.columns for one in seen])
    )


def _gathered(keys: Int64[np.ndarray, "q"], rows: Float64[np.ndarray, "q 11"]) -> _Sums:
    """Sums of the rows of each number."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.diff(ordered, prepend=ordered[:1] - 1))
    return _Sums(ordered[first], np.add.reduceat(rows[order], first, axis=0))


def _points(sums: Float64[np.ndarray, "v 11"]) -> FusedPoints:
    """Means of what `_Sums` sums."""
    views = sums[:, 10:]
    normals = sums[:, 6:9]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    colours = sums[:, 3:6] / np.where(sums[:, 9:10] > 0, sums[:, 9:10], 1)
    return FusedPoints(
        points=(sums[:, :3] / views).astype(np.float32),
        colours=colours.astype(np.float32),
        normals=(normals / np.where(length > 0, length, 1)).astype(np.float32),
        views=np.rint(views[:, 0]).astype(np.int64),
    )
