"""From a model's linear light to images that may be compared with stored ones.

A model that saw frames develops its own light. Events alone report changes of log intensity, so a
field learned from nothing else knows its light up to an unknown offset and an unknown gain (the
contrast threshold) of the logarithm. Before comparing, one line per channel is fitted that takes
the log of rendered light to the log of stored values, over all compared images at once; it
absorbs any power-law tone curve as well. A sensor without colour filters knows luma only.

Source: the evaluation of EventNeRF (CVPR 2023) and of the event-based fields that followed it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.tone import luma

DARK = 1e-3
"""Values below this count as this: the logarithm of nearly nothing would rule the fit."""

Image = Float[Tensor, "h w c"]


@dataclass(frozen=True)
class LogAffine:
    """log(stored) = gain * log(light) + offset, for each channel."""

    gain: Float[Tensor, "c"]
    offset: Float[Tensor, "c"]

    def __call__(self, light: Image) -> Image:
        """Rendered light as the frames would store it."""
        return (self.gain * light.clamp_min(DARK).log() + self.offset).exp()


@dataclass(frozen=True)
class Brightness:
    """How light becomes a image, and in which channels images are compared."""

    encode: Callable[[Tensor], Tensor]
    """As the frames store light, if the model knows that."""
    aligned: LogAffine | None = None
    """Used instead, if it does not."""
    grey: bool = False
    """Whether only luma is compared."""

    def image(self, light: Image) -> Float[Tensor, "h w d"]:
        """Display domain, 0...1, not quantised."""
        light = self.reference(light)
        return (self.encode(light) if self.aligned is None else self.aligned(light)).clamp(0, 1)

    def reference(self, image: Image) -> Float[Tensor, "h w d"]:
        """An image in the channels that are compared."""
        return luma(image)[..., None] if self.grey else image

    def words(self) -> dict[str, Any] | None:
        """For the protocol; None if nothing was aligned."""
        if self.aligned is None:
            return None
        return {
            "kind": "log-affine per channel: least squares in log intensity, all views at once",
            "gain": self.aligned.gain.tolist(),
            "offset": self.aligned.offset.tolist(),
        }


def fit_brightness(
    encode: Callable[[Tensor], Tensor],
    compared: Sequence[tuple[Image, Float[Tensor, "h w d"]]],
    *,
    grey: bool,
) -> Brightness:
    """The brightness of a model of events alone.

    Args:
        encode: Used where there is nothing to align to.
        compared: Pairs of rendered light and reference.
        grey: The sensor had no colour filters.
    """
    plain = Brightness(encode, grey=grey)
    if not compared:
        return plain
    light = [plain.reference(light) for light, _ in compared]
    stored = [plain.reference(image) for _, image in compared]
    return Brightness(encode, fit_log_affine(light, stored), grey=grey)


def fit_log_affine(light: Sequence[Image], stored: Sequence[Image]) -> LogAffine:
    """The line per channel with the least squared error in log intensity, over all images."""
    x = torch.cat([image.flatten(0, 1) for image in light]).double().clamp_min(DARK).log()
    y = torch.cat([image.flatten(0, 1) for image in stored]).double().clamp_min(DARK).log()
    from_x = x - x.mean(0)
    spread = from_x.square().sum(0)
    slope = (from_x * (y - y.mean(0))).sum(0) / spread.clamp_min(torch.finfo(x.dtype).tiny)
    # A render of one single brightness fixes no gain.
    gain = torch.where(spread > 0, slope, torch.zeros_like(slope))
    return LogAffine(gain.float(), (y.mean(0) - gain * x.mean(0)).float())
