"""Blurry frames: the mean of linear light over an exposure, with a sensor's noise and encoding.

Errors of real depth cameras: noise, holes, and poses that drift.

Noise grows with the square of depth, as for every camera that triangulates. There are *holes*,
where nothing is measured, on surfaces at a grazing angle, beside depth edges (which are visible to
only one of the two cameras), and beyond the range of the sensor. Poses of a SLAM system *drift*
slowly away from the true path.

Source: Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data" (Sensors 2012), for
the law of the noise and its size, 1.4 mm at a metre; Nguyen et al., "Modeling Kinect sensor noise"
(3DIMPVT 2012), for the angles at which measuring ends.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16

from sharpfield.core.camera import Camera
from sharpfield.core.errors import OptionError, expect_one_of
from sharpfield.core.frames import ENCODINGS, DepthMaps, Exposure
from sharpfield.core.seed import numpy_generator
from sharpfield.simulation.cameras.motions import CameraPath, Composed, Motion


@dataclass(frozen=True)
class FrameSensor:
    """How a frame camera stores light."""

    encoding: str = "gamma2.2"
    """Response curve: "gamma2.2", "srgb" or "linear"."""
    bits: int = 8
    """Of a stored value: 8 or 16."""
    full_well: float = 0.0
    """Electrons at white, which set the photon noise; 0 for no photon noise."""
    read_noise: float = 0.0
    """Standard deviation of noise that does not depend on light, as a fraction of white."""
    row_delay_us: float = 0.0
    """Each row opens and closes this much later than the one above: a rolling shutter."""

    def __post_init__(self) -> None:
        expect_one_of("response curve", self.encoding, ENCODINGS)
        if self.bits not in (8, 16):
            raise OptionError("a stored value has 8 or 16 bits", got=self.bits)

    def noiseless(self) -> "FrameSensor":
        """The same response and precision, without noise: how truth is stored."""
        return replace(self, full_well=0.0, read_noise=0.0)


class Exposing:
    """Integrates the light of many exposures from a sequence of images.

    Light is linear in time between two images, so the mean is exact for such light; an exposure of
    no length takes the image at its instant.
    """

    def __init__(
        self, exposure: Exposure, size: tuple[int, int], *, row_delay_us: float = 0.0
    ) -> None:
        width, height = size
        delay = row_delay_us * np.arange(height)
        self._open = exposure.open_us[:, None] + delay  # [n, h]
        self._close = exposure.close_us[:, None] + delay
        self._sum = np.zeros((len(exposure), height, width, 3), np.float32)
        self._seen = np.zeros((len(exposure), height))
        self._before: Float32[np.ndarray, "h w 3"] | None = None
        self._before_us = 0

    def see(self, rgb: Float32[np.ndarray, "h w 3"], t_us: int) -> None:
        """Light at an instant, after all earlier ones."""
        before, start = self._before, self._before_us
        self._before, self._before_us = rgb, t_us
        if before is None:
            before, start = rgb, t_us
        near = (self._open[:, 0] <= t_us) & (self._close[:, -1] >= start)
        for i in np.flatnonzero(near):
            a, b = np.maximum(self._open[i], start), np.minimum(self._close[i], t_us)
            instant = self._open[i] == self._close[i]
            time = np.where(instant, (a == b) & (self._seen[i] == 0), np.maximum(b - a, 0))  # [h]
            if not time.any():
                continue
            u = ((0.5 * (a + b) - start) / max(t_us - start, 1)).clip(0, 1)
            early, late = (time * (1 - u)).astype(np.float32), (time * u).astype(np.float32)
            self._sum[i] += early[:, None, None] * before + late[:, None, None] * rgb
            self._seen[i] += time

    def means(self) -> Float32[np.ndarray, "n h w 3"]:
        """Mean linear light of each exposure.

        Raises:
            OptionError: The images did not cover an exposure.
        """
        length = np.where(self._open == self._close, 1.0, self._close - self._open)
        short = np.abs(self._seen - length) > 1e-6 * length
        if short.any():
            i = int(np.flatnonzero(short.any(1))[0])
            raise OptionError(
                "the images do not cover an exposure",
                where=f"exposure {i}",
                got=f"{self._seen[i].min():g} of {length[i, 0]:g} us seen",
                do="show images from before it opens until after it closes",
            )
        return self._sum / self._seen[..., None, None].astype(np.float32)


def encode(
    linear: Float32[np.ndarray, "*n h w c"], encoding: str
) -> Float32[np.ndarray, "*n h w c"]:
    """Display values of linear light, both 0...1."""
    light = np.clip(linear, 0, 1)
    if encoding == "linear":
        return light
    if encoding == "gamma2.2":
        return light ** np.float32(1 / 2.2)
    bent = 1.055 * np.maximum(light, 0.0031308) ** np.float32(1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, bent).astype(np.float32)


def decode(
    display: Float32[np.ndarray, "*n h w c"], encoding: str
) -> Float32[np.ndarray, "*n h w c"]:
    """Linear light of display values: the inverse of `encode`."""
    if encoding == "linear":
        return display
    if encoding == "gamma2.2":
        return display ** np.float32(2.2)
    bent = ((np.maximum(display, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(display <= 0.04045, display / 12.92, bent).astype(np.float32)


def store(
    linear: Float32[np.ndarray, "*n h w c"], sensor: FrameSensor, draw: np.random.Generator
) -> UInt8[np.ndarray, "*n h w c"] | UInt16[np.ndarray, "*n h w c"]:
    """Stored values of linear light: noise, response curve, clipping, rounding."""
    light = linear
    if sensor.full_well:
        light = (draw.poisson(light * sensor.full_well) / sensor.full_well).astype(np.float32)
    if sensor.read_noise:
        light = light + draw.normal(0, sensor.read_noise, light.shape).astype(np.float32)
    white = 2**sensor.bits - 1
    stored = np.rint(encode(light, sensor.encoding) * white)
    return stored.astype(np.uint8 if sensor.bits == 8 else np.uint16)


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


def drifting(path: CameraPath, most: float, seed: int) -> CameraPath:
    """A path as a SLAM system estimates it: its world drifts by up to about `most` metres.

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
    return Composed(Motion(np.array(DRIFT_HZ), size, phase), path)
