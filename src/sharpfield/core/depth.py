"""What a depth camera measured beside the frames: one map for each frame, on the same clock.

Depth is along the camera's axis, at pixel centres. The depth camera may have fewer pixels than the
frames and a lens of its own, but stands where the frame camera stands (data sets call that
*registered*). Maps stay as sensors store them, 16 bit, so that they can be mapped from disk.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt16

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError

MILLIMETRE = 0.001
"""What one step of a stored depth means to most sensors, in metres."""


@dataclass(frozen=True)
class DepthMaps:
    """A measured depth map for each frame; unlike `Frames.depth`, which is the truth."""

    stored: UInt16[np.ndarray, "n h w"]
    """In steps of `unit`; 0 where nothing was measured."""
    camera: Camera
    """Lens and sensor of the depth camera."""
    unit: float = MILLIMETRE
    """World units in one step."""

    def __post_init__(self) -> None:
        if self.stored.shape[1:] != self.camera.size[::-1]:
            raise CaptureError(
                "depth maps and their camera have different sizes",
                got=f"maps {self.stored.shape[2]}x{self.stored.shape[1]},"
                f" camera {self.camera.width}x{self.camera.height}",
                do="give the intrinsics of the depth camera",
            )
        if not self.unit > 0:
            raise CaptureError("a step of depth must be positive", got=self.unit)

    def __len__(self) -> int:
        """Number of maps."""
        return len(self.stored)

    def at(self, frame: int) -> Float32[np.ndarray, "h w"]:
        """Depth in world units seen by one frame; 0 where unknown."""
        return np.asarray(self.stored[frame]).astype(np.float32) * np.float32(self.unit)

    def rays(self) -> Float32[np.ndarray, "h w 3"]:
        """Directions of all pixels in camera axes, with a z of 1: times depth, they are points."""
        unit = self.camera.direction(self.camera.grid().double())
        return (unit / unit[..., 2:]).to(torch.float32).numpy()
