"""A room of one box, textured by waves, seen from inside by a depth camera."""

import functools

import numpy as np

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.frames import DepthMaps, Exposure, Frames
from sharpfield.geometry.trajectory import Still

SIZE = np.array([4.0, 3.0, 5.0])


def pose(angle: float) -> np.ndarray:
    """A camera near the middle that looks around."""
    eye = SIZE / 2 + 0.3 * np.array([np.cos(angle), 0.2 * np.sin(3 * angle), np.sin(angle)])
    forward = np.array([np.cos(angle), 0.1, np.sin(angle)])
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, eye], 1)


def image(camera: Camera, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stored values 0...1 and depth."""
    ray = camera.direction(camera.grid().double()).numpy()
    ray = ray / ray[..., 2:]
    turned = ray @ at[:, :3].T
    with np.errstate(divide="ignore"):
        depth = np.maximum((0 - at[:, 3]) / turned, (SIZE - at[:, 3]) / turned).min(-1)
    place = at[:, 3] + turned * depth[..., None]
    waves = np.sin(place @ np.array([[3.0, 1, 2], [1, 4, 1], [2, 2, 3]]) + [0, 1, 2])
    return 0.5 + 0.4 * waves, depth


@functools.cache
def box(frames: int = 10, size: tuple[int, int] = (24, 18)) -> Capture:
    """Every fifth frame is held out."""
    width, height = size
    camera = Camera(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
    poses = np.stack([pose(0.25 * i) for i in range(frames)])
    seen = [image(camera, one) for one in poses]
    images = np.rint(255 * np.stack([one for one, _ in seen])).astype(np.uint8)
    depth = np.rint(1000 * np.stack([one for _, one in seen])).astype(np.uint16)
    times = 1_000_000 * np.arange(frames, dtype=np.int64)
    every = np.arange(frames)
    return Capture(
        camera=camera,
        trajectory=Still(poses),
        clock=Clock(0, int(times[-1])),
        near=0.2,
        far=6.0,
        frames=Frames(images, Exposure(times, times), every, tuple(f"{i:04d}" for i in every)),
        depth=DepthMaps(depth, camera),
        split=Split(every[every % 5 != 0], every[every % 5 == 0]),
        name="box",
    )
