"""Random motion blur kernels: camera shake that is the same over the whole image.

A kernel of *size* k is drawn on a canvas of 2k by 2k: a polyline of short steps whose directions
vary more the larger the *intensity* phi; then it is downscaled to k by k. With a small phi the
stroke is nearly straight.

Source: the generator named by Hybrid Neural Rendering (CVPR 2023, supplement) for its synthetic
blur, with k drawn from 3...16 and phi from 0...0.1, for 75 % of the training frames.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16

from sharpfield.core.errors import OptionError

SIZE, INTENSITY, PROBABILITY = (3, 16), (0.0, 0.1), 0.75
"""The paper's ranges of k and phi, and fraction of frames that are blurred."""
SHORTEST = 1e-4
"""Least length of a stroke over the longest: steps are drawn until some are shorter than it."""
LOBES = 3
"""Of the Lanczos filter that downscales the canvas."""


@dataclass(frozen=True)
class KernelRange:
    """Ranges of random kernels."""

    k: tuple[int, int] = SIZE
    """Smallest and largest size, in px; the largest is never drawn."""
    phi: tuple[float, float] = INTENSITY
    """Least and greatest intensity, 0...1."""
    probability: float = PROBABILITY
    """Fraction of images that are blurred."""

    def __post_init__(self) -> None:
        if not 3 <= self.k[0] < self.k[1]:
            raise OptionError(
                "sizes of kernels must be at least 3 and rise", got=f"{self.k[0]} to {self.k[1]}"
            )
        if not 0 <= self.phi[0] <= self.phi[1] <= 1:
            raise OptionError(
                "intensities must lie between 0 and 1 and rise",
                got=f"{self.phi[0]} to {self.phi[1]}",
            )
        if not 0 <= self.probability <= 1:
            raise OptionError("a probability must lie between 0 and 1", got=self.probability)


PUBLISHED = KernelRange()


@dataclass(frozen=True)
class DrawnBlur:
    """One kernel and its parameters."""

    k: int
    phi: float
    kernel: Float32[np.ndarray, "k k"]
    """Sums to 1."""

    @property
    def length_px(self) -> float:
        """Length of the straight uniform stroke with the same variance along its main axis."""
        rows, columns = np.indices(self.kernel.shape).reshape(2, -1)
        weight = self.kernel.ravel().astype(np.float64)
        spread = np.cov(np.stack([columns, rows]), aweights=weight, ddof=0)
        return float(np.sqrt(max(12 * np.linalg.eigvalsh(spread)[-1], 0.0)))


def drawn_blur(ranges: KernelRange, draw: np.random.Generator) -> DrawnBlur | None:
    """A kernel for one image, or None for an image that stays sharp."""
    chance = draw.uniform()
    k, phi = int(draw.integers(*ranges.k)), float(draw.uniform(*ranges.phi))
    if chance >= ranges.probability:
        return None
    return DrawnBlur(k, phi, motion_kernel(k, phi, draw))


def motion_kernel(k: int, phi: float, draw: np.random.Generator) -> Float32[np.ndarray, "k k"]:
    """A random kernel of size k and intensity phi; it sums to 1."""
    import cv2

    diagonal = 2 * np.sqrt(2) * k
    steps = _steps(phi, diagonal, draw)
    way = np.cumsum(steps * np.exp(1j * _headings(len(steps), phi, draw)))
    way = (way - way.mean()) * np.exp(1j * draw.uniform(0, np.pi)) + (k + 1j * k)
    canvas = np.zeros((2 * k, 2 * k), np.uint8)
    corners = np.stack([way.real, way.imag], -1)
    width = max(int(diagonal / 150), 1)
    cv2.polylines(canvas, [np.rint(corners).astype(np.int32)], False, 255, width)
    if radius := int(0.01 * diagonal):
        canvas = cv2.GaussianBlur(canvas, (0, 0), radius)
    half = _halving(k)
    small = np.rint((half @ canvas @ half.T).clip(0, 255)).astype(np.float32)
    return small / small.sum()


def blurred(
    image: UInt8[np.ndarray, "h w c"] | UInt16[np.ndarray, "h w c"],
    kernel: Float32[np.ndarray, "k k"],
) -> UInt8[np.ndarray, "h w c"] | UInt16[np.ndarray, "h w c"]:
    """An image of the same size, its stored values convolved with a kernel.

    The border is replicated; published data darken there.
    """
    import cv2

    turned = cv2.flip(kernel, -1)  # OpenCV correlates
    anchor = (len(kernel) // 2,) * 2
    mixed = cv2.filter2D(
        image.astype(np.float32), -1, turned, anchor=anchor, borderType=cv2.BORDER_REPLICATE
    )
    white = np.iinfo(image.dtype).max
    return np.rint(mixed.clip(0, white)).astype(image.dtype).reshape(image.shape)


def _steps(phi: float, diagonal: float, draw: np.random.Generator) -> Float64[np.ndarray, "s"]:
    """Lengths of the steps, until the stroke is as long as was drawn."""
    length = 0.75 * diagonal * max(draw.uniform() + draw.uniform(0, phi * phi), SHORTEST)
    steps: list[float] = []
    while len(steps) < 2 or sum(steps) < length:
        step = draw.beta(1, 30) * (1.1 - phi) * diagonal
        if step < length:
            steps.append(step)
    return np.array(steps)


def _halving(k: int) -> Float64[np.ndarray, "k m"]:
    """Shrinks 2k samples to k with a Lanczos filter."""
    away = (np.arange(2 * k) + 0.5 - 2 * (np.arange(k)[:, None] + 0.5)) / 2
    weight = np.where(np.abs(away) < LOBES, np.sinc(away) * np.sinc(away / LOBES), 0)
    return weight / weight.sum(1, keepdims=True)


def _headings(count: int, phi: float, draw: np.random.Generator) -> Float64[np.ndarray, "s"]:
    """Directions of the steps, in rad: to one side, with random changes of side."""
    most = draw.uniform(0, phi * np.pi)
    flips = draw.uniform(size=count) < draw.beta(2, 20)
    headings = np.empty(count)
    headings[0] = draw.uniform(-most, most)
    sign = 1.0 if headings[0] >= 0 else -1.0
    for i in range(1, count):
        sign = -sign if flips[i] else sign
        headings[i] = sign * draw.triangular(0, phi * most, most + 0.1)
    return headings
