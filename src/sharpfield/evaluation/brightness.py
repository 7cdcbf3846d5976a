"""From the linear light of a model to images in the display domain.

A model trained on frames has a tone curve. Events report changes of log intensity only, so a model
trained on events alone has an unknown offset and an unknown gain (the contrast threshold) of the
log intensity. Before comparing, one line per channel is fitted from the log of rendered light to
the log of stored values, over all compared images at once; it absorbs any power-law tone curve as
well. A sensor without colour filters gives luma only.

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
"""Smallest value before the logarithm: values near zero would dominate the fit."""

Image = Float[Tensor, "h w c"]


@dataclass(frozen=True)
class LogAffine:
    """log(stored) = gain * log(light) + offset, for each channel."""

    gain: Float[Tensor, "c"]
    offset: Float[Tensor, "c"]

    def __call__(self, light: Image) -> Image:
        """Rendered light as stored values."""
        return (self.gain * light.clamp_min(DARK).log() + self.offset).exp()


@dataclass(frozen=True)
class Brightness:
    """Conversion of light to images, and the channels in which images are compared."""

    encode: Callable[[Tensor], Tensor]
    """Tone curve of the model."""
    aligned: LogAffine | None = None
    """Used instead of the tone curve, if given."""
    grey: bool = False
    """Whether only luma is compared."""

    def image(self, light: Image) -> Float[Tensor, "h w d"]:
        """Rendered light in the display domain, 0...1, not quantised."""
        light = self.reference(light)
        return (self.encode(light) if self.aligned is None else self.aligned(light)).clamp(0, 1)

    def reference(self, image: Image) -> Float[Tensor, "h w d"]:
        """An image in the channels that are compared."""
        return luma(image)[..., None] if self.grey else image

    def stated(self) -> dict[str, Any] | None:
        """Entry of the protocol; None if nothing was aligned."""
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
    """The aligned brightness of a model trained on events alone.

    Args:
        encode: Tone curve, used where there is nothing to align to.
        compared: Pairs of rendered light and reference.
        grey: Whether the sensor has no colour filters.
    """
    plain = Brightness(encode, grey=grey)
    if not compared:
        return plain
    light = [plain.reference(light) for light, _ in compared]
    stored = [plain.reference(image) for _, image in compared]
    return Brightness(encode, fit_log_affine(light, stored), grey=grey)


def fit_log_affine(light: Sequence[Image], stored: Sequence[Image]) -> LogAffine:
    """The line per channel with the least squared error in log intensity, over all images."""
    # [all pixels, c] of all images
    x = torch.cat([image.flatten(0, 1) for image in light]).double().clamp_min(DARK).log()
    y = torch.cat([image.flatten(0, 1) for image in stored]).double().clamp_min(DARK).log()
    centred = x - x.mean(0)
    variance = centred.square().sum(0)
    slope = (centred * (y - y.mean(0))).sum(0) / variance.clamp_min(torch.finfo(x.dtype).tiny)
    # Renders of constant brightness do not determine a gain.
    gain = torch.where(variance > 0, slope, torch.zeros_like(slope))
    return LogAffine(gain.float(), (y.mean(0) - gain * x.mean(0)).float())
