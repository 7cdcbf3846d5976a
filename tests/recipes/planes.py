"""Images of two textured walls, made ray by ray: the depth of every pixel is known."""

import numpy as np
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.seed import numpy_generator
from sharpfield.initialisation.posed_images import Images

CAMERA = Camera(120, 90, 110.0, 110.0, 60.0, 45.0)
NEAR_WALL, FAR_WALL, EDGE = 3.0, 5.0, 0.0
"""Depths of the wall at x below the edge, and of the one behind it."""


def texture(x: np.ndarray, y: np.ndarray, layer: int) -> np.ndarray:
    """Blobs of several sizes: bilinear noise."""
    noise = numpy_generator(0, layer, "texture").random((2, 128, 128))
    value = np.zeros_like(x)
    for cells, octave in zip((4.0, 9.0), noise, strict=True):
        u, v = (x + 7) * cells, (y + 7) * cells
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = u - i, v - j
        at = lambda di, dj, o=octave, i=i, j=j: o[(i + di) % 128, (j + dj) % 128]  # noqa: E731
        value += 0.5 * (
            (1 - a) * ((1 - b) * at(0, 0) + b * at(0, 1)) + a * ((1 - b) * at(1, 0) + b * at(1, 1))
        )
    return value


def depth_at(points: np.ndarray) -> np.ndarray:
    """Of the wall that a point is on or nearest to."""
    return np.where(np.abs(points[:, 2] - NEAR_WALL) < 1, NEAR_WALL, FAR_WALL)


def image(camera: Camera, pose: np.ndarray) -> np.ndarray:
    ray = camera.direction(camera.grid().double()).numpy() @ pose[:, :3].T
    hits = [pose[:, 3] + ((z - pose[2, 3]) / ray[..., 2])[..., None] * ray for z in (3.0, 5.0)]
    shown = [texture(*hit[..., :2].transpose(2, 0, 1), layer) for layer, hit in enumerate(hits)]
    return np.where(hits[0][..., 0] < EDGE, *shown)


def images(count: int = 5, *, camera: Camera = CAMERA) -> Images:
    """A camera that moves sideways and turns a little."""
    poses = np.zeros((count, 3, 4))
    for i in range(count):
        turn = torch.tensor(0.02 * (i - count // 2))
        poses[i, :, :3] = np.eye(3)
        poses[i, 0, [0, 2]] = turn.cos(), turn.sin()
        poses[i, 2, [0, 2]] = -turn.sin(), turn.cos()
        poses[i, :, 3] = 0.15 * i - 0.3, 0.05 * (i % 2), 0.02 * i
    values = np.stack([image(camera, pose) for pose in poses])
    colours = np.repeat(values[..., None], 3, -1).astype(np.float32)
    return Images(camera, colours, poses, 2.0, 8.0)
