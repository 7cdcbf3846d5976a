"""Depth maps of a depth camera, resampled to the pixels of the frames."""

import numpy as np
from jaxtyping import Bool, Float32, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.frames import LEAST_DEPTH, DepthMaps


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
