"""Points to start from on the surfaces that a depth camera measured."""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Generator

from sharpfield.core.capture import Capture
from sharpfield.core.tone import Tone
from sharpfield.initialisation.start_points import StartPoints
from sharpfield.sampling.measured_depth import MeasuredDepth

MAX_FRAMES = 48
"""Frames whose pixels become points; neighbours in a walk see the same."""


def points_on_surfaces(
    capture: Capture,
    tone: Tone,
    count: int,
    generator: Generator,
    *,
    weights: Float[np.ndarray, "n"] | None = None,
    size: float = 0.7,
) -> StartPoints:
    """Points at measured depth, with the colours of the frames' pixels.

    Args:
        capture: With frames and depth.
        tone: Of the frames.
        count: How many points, if enough depth is known.
        generator: On the CPU; chooses the pixels.
        weights: Of each training frame, for its quality; the best of neighbouring frames is used.
        size: Of each point, relative to the distance between neighbours if all of them covered
            the surfaces evenly.
    """
    depth = MeasuredDepth(capture.needed_depth, capture.camera)
    chosen = _best_frames(capture.split.train, weights)
    frames, camera = capture.needed_frames, capture.camera
    ray = camera.direction(camera.grid().double()).numpy()
    ray = ray / ray[..., 2:]
    poses = capture.frame_pose(chosen).detach().double().numpy()
    each = -(-count // len(chosen))
    points, colours, depths = [], [], []
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
        depths.append(far)
    xyz, far = np.concatenate(points)[:count], np.concatenate(depths)[:count]
    spacing = _spacing(xyz)
    return StartPoints(
        xyz.astype(np.float32),
        np.concatenate(colours)[:count].astype(np.float32),
        (size * np.minimum(spacing, 0.1 * far)).astype(np.float32),
    )


def _best_frames(
    train: Int64[np.ndarray, "t"], weights: Float[np.ndarray, "t"] | None
) -> Int64[np.ndarray, "m"]:
    """At most `MAX_FRAMES` frames, spread over the capture, the best of their neighbours."""
    groups = np.array_split(np.arange(len(train)), min(MAX_FRAMES, len(train)))
    if weights is None:
        return train[[group[len(group) // 2] for group in groups]]
    return train[[group[np.argmax(weights[group])] for group in groups]]


def _spacing(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Approximate distance between neighbours at each point, from counts in cubes."""
    edge = np.ptp(points, axis=0).max() / 64 + 1e-9
    cube = np.floor(points / edge).astype(np.int64)
    _, which, counts = np.unique(cube, axis=0, return_inverse=True, return_counts=True)
    # A surface crosses a cube in about its edge squared.
    return edge / np.sqrt(counts[which.reshape(-1)])
