"""Blurry frames: the mean of linear light over an exposure, with a sensor's noise and encoding."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from sharpfield.core.errors import OptionError
from sharpfield.core.frames import ENCODINGS, Exposure


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
        if self.encoding not in ENCODINGS:
            raise OptionError(
                "unknown response curve", got=self.encoding, do=f"use one of {', '.join(ENCODINGS)}"
            )
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
