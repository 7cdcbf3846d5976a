"""Metrics of all held-out views together: PSNR after aligning brightness, error of depth.

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
from sharpfield.metrics.registry import HIGHEST_PSNR, Metric

DARK = 0.1
"""Added to display values before the logarithm (published)."""

OPAQUE = 0.5
"""Opacity from which a rendered pixel counts as having a depth."""

TINY = 1e-9

PSNR_ALIGNED = Metric(
    "psnr_aligned",
    "aligned PSNR (dB)",
    "psnr of the luma, once log(0.1 + luma) of each image is fitted to that of its reference by a"
    " gain and an offset (as published)",
    "higher",
    "{:.2f}",
)
"""Computed where the capture has events, by `aligned_psnr` for each view."""

DEPTH_ERROR = Metric(
    "depth_error",
    "depth error",
    "mean relative error of the depth of each view, at most 1 a pixel, where the truth has one,"
    " after a common scale (the ratio of the medians of all views); what is less than half opaque"
    " counts 1",
    "lower",
    "{:.4f}",
)
"""Computed where the capture has true depth, by `scaled_depth_error` for all views at once."""


def aligned_psnr(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> float:
    """PSNR after fitting the brightness of an image to that of its reference, both 0...1."""
    target, log_luma = ((luma(one).double() + DARK).log() for one in (reference, image))
    variance = log_luma.var(correction=0).clamp_min(TINY)
    gain = ((target * log_luma).mean() - target.mean() * log_luma.mean()) / variance
    fitted = (gain * (log_luma - log_luma.mean()) + target.mean()).exp() - DARK  # [h, w]
    found = psnr(fitted.clamp(0, 1)[..., None].float(), luma(reference)[..., None].float())
    return min(float(found), HIGHEST_PSNR)


def scaled_depth_error(
    rendered: Sequence[Float[Tensor, "h w"]],
    opacity: Sequence[Float[Tensor, "h w"]],
    truth: Sequence[Float32[np.ndarray, "h w"]],
) -> float | None:
    """Mean relative error of depth after a common scale; None where no truth is finite.

    Args:
        rendered: Distances of each view, in any unit.
        opacity: Of the same pixels.
        truth: Distances; infinite or zero where there is nothing.
    """
    known = [np.isfinite(one) & (one > 0) for one in truth]
    opaque = [one.numpy() >= OPAQUE for one in opacity]
    both = [k & o for k, o in zip(known, opaque, strict=True)]
    if not any(k.any() for k in known):
        return None
    if not any(b.any() for b in both):
        return 1.0
    found = [one.double().numpy() for one in rendered]
    medians = [
        np.median(np.concatenate([one[b] for one, b in zip(maps, both, strict=True)]))
        for maps in (found, truth)
    ]
    scale = medians[1] / max(medians[0], TINY)
    errors = []
    for found_one, true_one, known_one, both_one in zip(found, truth, known, both, strict=True):
        if not known_one.any():
            continue
        relative = np.abs(scale * found_one - true_one) / np.where(known_one, true_one, 1)
        error = np.where(both_one, np.minimum(relative, 1), 1)  # [h, w]
        errors.append(float(error[known_one].mean()))
    return math.fsum(errors) / len(errors)


def distances(depth: Float32[np.ndarray, "h w"], camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Depth along the optical axis as distance along the ray of each pixel."""
    toward = camera.direction(camera.grid().double())
    return (depth / toward[..., 2].numpy()).astype(np.float32)
