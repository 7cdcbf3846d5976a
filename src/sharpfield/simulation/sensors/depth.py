"""Errors of real depth cameras: noise, holes, and poses that drift.

Noise grows with the square of depth, as for every camera that triangulates. There are *holes*,
where nothing is measured, on surfaces at a grazing angle, beside depth edges (which are visible to
only one of the two cameras), and beyond the range of the sensor. Poses of a SLAM system *drift*
slowly away from the true path.

Source: Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data" (Sensors 2012), for
the law of the noise and its size, 1.4 mm at a metre; Nguyen et al., "Modeling Kinect sensor noise"
(3DIMPVT 2012), for the angles at which measuring ends.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.errors import OptionError
from sharpfield.core.frames import DepthMaps
from sharpfield.core.seed import numpy_generator
from sharpfield.geometry import se3
from sharpfield.simulation.cameras.motions import CameraPath, Motion

BLOTCH_PX = 3
"""Noise of neighbours is correlated: it is averaged over so many pixels a side."""
EDGE = 0.05
"""A larger relative change of depth from pixel to pixel is an edge."""
DRIFT_HZ = (0.013, 0.031, 0.072)
"""Frequencies of the drift."""
ARM_M = 3.0
"""Distance from the origin at which the rotation of the drift moves points as its translation."""


@dataclass(frozen=True)
class DepthSensor:
    """A depth camera, exact by default."""

    noise: float = 0.0
    """Standard deviation in metres of depth at one metre; a Kinect's is 0.0014. With any noise
    there are holes as well."""
    steepest_deg: float = 78.0
    """Surfaces seen at a larger angle to their normal are not measured."""
    farthest: float = 5.0
    """Nothing is measured beyond, in metres."""

    def __post_init__(self) -> None:
        if not 0 <= self.noise < 0.1:
            raise OptionError("noise of depth lies between 0 and 0.1 m", got=self.noise)

    def measure(
        self, depth: Float32[np.ndarray, "h w"], camera: Camera, draw: np.random.Generator
    ) -> Float[np.ndarray, "h w"]:
        """The depth map that this sensor measures; 0 where it cannot.

        Args:
            depth: The truth, along the axis.
            camera: Of the depth map.
            draw: Random generator of the noise.
        """
        if self.noise == 0:
            return depth
        exact, white = depth.astype(np.float64), draw.standard_normal(depth.shape)
        blotchy = BLOTCH_PX * cv2.blur(white, (BLOTCH_PX, BLOTCH_PX))
        seen = self.seen(depth, camera)
        return np.where(seen, (exact + self.noise * exact**2 * blotchy).clip(0), 0)

    def seen(self, depth: Float32[np.ndarray, "h w"], camera: Camera) -> Bool[np.ndarray, "h w"]:
        """Pixels at which the sensor measures."""
        near = np.isfinite(depth) & (depth < self.farthest)
        exact = np.where(np.isfinite(depth), depth, 0).astype(np.float64)
        rays = DepthMaps(np.zeros((1, *depth.shape), np.uint16), camera).rays()
        points = rays * exact[..., None]
        across = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        size = np.linalg.norm(across, axis=-1) * np.linalg.norm(points, axis=-1)
        facing = np.abs((across * points).sum(-1)) > np.cos(np.deg2rad(self.steepest_deg)) * size
        change = np.maximum(*(np.abs(np.gradient(exact, axis=axis)) for axis in (0, 1)))
        return near & facing & (change < EDGE * exact)


@dataclass(frozen=True)
class Drifting:
    """A path as estimated by a SLAM system."""

    path: CameraPath
    drift: Motion
    """Of the world."""

    def poses(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 4"]:
        """World-from-camera, with drift."""
        drift, path = (torch.from_numpy(one.poses(t_us)) for one in (self.drift, self.path))
        return se3.compose(drift, path).numpy()


def drifting(path: CameraPath, most: float, seed: int) -> CameraPath:
    """A path that drifts by up to about `most` metres.

    Args:
        path: The true one.
        most: 0 gives the path itself.
        seed: Of the drift.
    """
    if most == 0:
        return path
    draw = numpy_generator(seed, 0, "drift")
    size = draw.uniform(0.5, 1, (len(DRIFT_HZ), 6)) * most / len(DRIFT_HZ)
    size[:, 3:] /= ARM_M
    phase = draw.uniform(0, 2 * np.pi, size.shape)
    return Drifting(path, Motion(np.array(DRIFT_HZ), size, phase))
