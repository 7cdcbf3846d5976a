"""What a depth camera adds to a recipe on Gaussians: where to start, and how far surfaces are.

The depth camera stands where the frame camera stands, but may have other pixels; each pixel of a
frame is given the depth of the depth camera's pixel that looks along the same ray, or none.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Generator, Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.depth import DepthMaps
from sharpfield.formation.tone import Tone
from sharpfield.recipes.start_points import StartPoints

LEAST_DEPTH = 1e-6
"""Below this a stored depth means that nothing was measured."""

SEEN_FROM = 48
"""Frames whose pixels become first points; neighbours in a walk see the same."""


class MeasuredDepth:
    """Depth for the pixels of frames.

    Args:
        maps: Of the depth camera.
        camera: Of the frames.
    """

    def __init__(self, maps: DepthMaps, camera: Camera) -> None:
        self.maps = maps
        ray = camera.direction(camera.grid().double())
        xy = maps.camera.project(ray / ray[..., 2:]).numpy()
        x, y = np.floor(xy[..., 0]).astype(np.int64), np.floor(xy[..., 1]).astype(np.int64)
        self.inside: Bool[np.ndarray, "h w"] = (
            (x >= 0) & (x < maps.camera.width) & (y >= 0) & (y < maps.camera.height)
        )
        self.column: Int64[np.ndarray, "h w"] = np.where(self.inside, x, 0)
        self.row: Int64[np.ndarray, "h w"] = np.where(self.inside, y, 0)

    def at(self, frame: int) -> Float32[np.ndarray, "h w"]:
        """Depth along the axis at every pixel of a frame; 0 where unknown."""
        seen = self.maps.at(frame)[self.row, self.column]
        return np.where(self.inside & (seen > LEAST_DEPTH), seen, 0).astype(np.float32)


def depth_error(drawn: Float[Tensor, "*b"], measured: Float[Tensor, "*b"]) -> Float[Tensor, ""]:
    """Mean of how far drawn depth is off, as a part of what was measured; 0 is unknown."""
    known = measured > 0
    off = (drawn - measured).abs() / measured.clamp_min(LEAST_DEPTH)
    # Beyond its own size an error says no more: one of the two sees past an edge.
    return torch.where(known, off.clamp_max(1), 0).sum() / known.sum().clamp_min(1)


def points_on_surfaces(
    capture: Capture,
    tone: Tone,
    count: int,
    generator: Generator,
    *,
    weights: Float[np.ndarray, "n"] | None = None,
    size: float = 0.7,
) -> StartPoints:
    """Points that the depth camera measured, with the colours that frames show there.

    Args:
        capture: With frames and depth.
        tone: Of the frames.
        count: How many points, if enough depth is known.
        generator: On the CPU; decides which pixels are taken.
        weights: Of each training frame, for its quality; of neighbours the best one is taken.
        size: Of each point, relative to the distance of its neighbours if all of them filled
            the surfaces evenly.
    """
    depth = MeasuredDepth(capture.needed_depth, capture.camera)
    chosen = _sharpest(capture.split.train, weights)
    frames, camera = capture.needed_frames, capture.camera
    ray = camera.direction(camera.grid().double()).numpy()
    ray = ray / ray[..., 2:]
    poses = capture.frame_pose(chosen).detach().double().numpy()
    each = -(-count // len(chosen))
    points, colours, away = [], [], []
    for frame, pose in zip(chosen, poses, strict=True):
        seen = depth.at(int(frame))
        row, column = np.nonzero(seen)
        if not len(row):
            continue
        take = torch.randint(len(row), (each,), generator=generator).numpy()
        row, column = row[take], column[take]
        far = seen[row, column].astype(np.float64)
        points.append(far[:, None] * ray[row, column] @ pose[:, :3].T + pose[:, 3])
        stored = torch.from_numpy(frames.images[frame][row, column].astype(np.float32))
        colours.append(tone.decode(stored / frames.white).numpy())
        away.append(far)
    xyz, far = np.concatenate(points)[:count], np.concatenate(away)[:count]
    apart = _apart(xyz)
    return StartPoints(
        xyz.astype(np.float32),
        np.concatenate(colours)[:count].astype(np.float32),
        (size * np.minimum(apart, 0.1 * far)).astype(np.float32),
    )


def _sharpest(
    train: Int64[np.ndarray, "t"], weights: Float[np.ndarray, "t"] | None
) -> Int64[np.ndarray, "m"]:
    """At most `SEEN_FROM` frames, spread over the capture, the best of their neighbourhood."""
    groups = np.array_split(np.arange(len(train)), min(SEEN_FROM, len(train)))
    if weights is None:
        return train[[group[len(group) // 2] for group in groups]]
    return train[[group[np.argmax(weights[group])] for group in groups]]


def _apart(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """About how far the neighbours of each point are: from points counted in cubes."""
    edge = np.ptp(points, axis=0).max() / 64 + 1e-9
    cube = np.floor(points / edge).astype(np.int64)
    _, which, counts = np.unique(cube, axis=0, return_inverse=True, return_counts=True)
    # A surface crosses a cube in about its edge squared.
    return edge / np.sqrt(counts[which.reshape(-1)])
