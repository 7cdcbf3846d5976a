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
from jaxtyping import Bool, Float32, Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import DepthMaps

PENDING = 3_000_000
"""Voxels of single frames that are gathered before they are merged; bounds memory. As many as are
known already may be gathered, so that time grows with the frames and not with their square."""

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
    columns: Float64[np.ndarray, "11 v"]
    """Summed place (3), weighted colour (3), normal (3), weight, count."""

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self.keys)


@dataclass(frozen=True)
class _Looking:
    """Where the pixels of a depth map look, and which pixel of a frame shows the same."""

    rays: Float32[np.ndarray, "h w 3"]
    """With a z of 1."""
    row: Int64[np.ndarray, "h w"]
    column: Int64[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]
    """Whether there is such a pixel."""


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
    depth, looking = capture.needed_depth, _looking(capture, stride)
    chosen = capture.split.train if frames == "train" else np.arange(len(depth))
    poses = capture.frame_pose(chosen).detach().double().numpy()
    origin = poses[:, :, 3].mean(0) if len(poses) else np.zeros(3)
    known, seen = _merged([]), []
    for frame, pose in zip(chosen.tolist(), poses, strict=True):
        share = 1.0 if weight is None else float(weight[frame])
        measured = depth.at(frame)[::stride, ::stride]
        valid = (measured > max(nearest, 0)) & (measured < farthest)
        columns = _seen(capture, frame, looking, np.where(valid, measured, 0), pose, share)
        keys = _voxels(columns[:3].T - origin, voxel, capture.name)
        seen.append(_summed(keys, columns))
        if sum(map(len, seen)) > max(PENDING, len(known)):
            known, seen = _merged([known, *seen]), []
    known = _merged([known, *seen])
    if not len(known):
        raise CaptureError(
            "the depth maps show no points",
            where=capture.name,
            got=f"{len(chosen)} frames, depth {nearest} to {farthest}",
        )
    return _points(known.columns)


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


def _looking(capture: Capture, stride: int) -> _Looking:
    """The same for all frames, since both cameras stand in one place."""
    rays = np.ascontiguousarray(capture.needed_depth.rays()[::stride, ::stride])
    xy = capture.camera.project(torch.from_numpy(rays.astype(np.float64))).numpy()
    column, row = np.moveaxis(np.floor(xy).astype(np.int64), -1, 0)
    width, height = capture.camera.size
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return _Looking(rays, row, column, inside)


def _seen(
    capture: Capture,
    frame: int,
    looking: _Looking,
    depth: Float32[np.ndarray, "h w"],
    pose: Float64[np.ndarray, "3 4"],
    share: float,
) -> Float64[np.ndarray, "11 q"]:
    """What each pixel of one frame saw: the columns of `_Sums`, of a single pixel each."""
    frames, inside = capture.needed_frames, looking.rays * depth[..., None]
    held = (depth > 0) & looking.inside
    colour = np.asarray(frames.images[frame])[looking.row[held], looking.column[held]]
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


def _summed(keys: Int64[np.ndarray, "q"], columns: Float64[np.ndarray, "11 q"]) -> _Sums:
    """Means over the pixels of one frame in each voxel: together they count as one view."""
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
