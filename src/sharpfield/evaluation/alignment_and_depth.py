"""Numbers beside those of images: brightness left open, depth.

Source: EvDNeRF (WACV 2024) for the alignment of single images, which is EventNeRF's (CVPR 2023)
formula.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.tone import luma
from sharpfield.metrics.image import psnr

DARK = 0.1
"""Added to display values before the logarithm (published)."""

SOLID = 0.5
"""Opacity from which a render claims that something is there."""

TINY = 1e-9

DEFINITIONS = {
    "psnr_aligned": "psnr of the luma, once log(0.1 + luma) of each image is fitted to that of"
    " its reference by a gain and an offset (as published)",
    "depth_error": "mean relative error of the depth of each view, at most 1 a pixel, where the"
    " truth has one, after a common scale (the ratio of the medians of all views); what is less"
    " than half opaque counts 1",
}


def aligned_psnr(
    image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"], highest: float = 100.0
) -> float:
    """PSNR after the brightness of a image was brought to its reference's, both 0...1."""
    want, have = ((luma(one).double() + DARK).log() for one in (reference, image))
    spread = have.var(correction=0)
    gain = ((want * have).mean() - want.mean() * have.mean()) / spread.clamp_min(TINY)
    fitted = (gain * (have - have.mean()) + want.mean()).exp() - DARK
    found = psnr(fitted.clamp(0, 1)[..., None].float(), luma(reference)[..., None].float())
    return min(float(found), highest)


def depth_error(
    drawn: Sequence[Float[Tensor, "h w"]],
    opacity: Sequence[Float[Tensor, "h w"]],
    truth: Sequence[Float32[np.ndarray, "h w"]],
) -> float | None:
    """Mean relative error of depth; None where no truth is finite.

    Args:
        drawn: Distances of each view, in any unit.
        opacity: Of the same pixels.
        truth: Distances; infinite or zero where there is nothing.
    """
    known = [np.isfinite(one) & (one > 0) for one in truth]
    solid = [one.numpy() >= SOLID for one in opacity]
    both = [k & s for k, s in zip(known, solid, strict=True)]
    if not any(k.any() for k in known):
        return None
    if not any(b.any() for b in both):
        return 1.0
    have = [one.double().numpy() for one in drawn]
    pairs = list(zip(have, truth, both, strict=True))
    medians = [np.median(np.concatenate([one[i][one[2]] for one in pairs])) for i in (0, 1)]
    scale = medians[1] / max(medians[0], TINY)
    errors = []
    for drawn_one, true_one, known_one, both_one in zip(have, truth, known, both, strict=True):
        if not known_one.any():
            continue
        off = np.abs(scale * drawn_one - true_one) / np.where(known_one, true_one, 1)
        errors.append(float(np.where(both_one, np.minimum(off, 1), 1)[known_one].mean()))
    return math.fsum(errors) / len(errors)


def distances(depth: Float32[np.ndarray, "h w"], camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Depth along the axis of a camera as distance along each pixel's ray."""
    toward = camera.direction(camera.grid().double())
    return (depth / toward[..., 2].numpy()).astype(np.float32)
