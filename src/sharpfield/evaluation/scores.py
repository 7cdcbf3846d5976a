"""The numbers of one image, and their means."""

import math
from collections.abc import Iterable, Mapping

from jaxtyping import Float
from torch import Tensor

from sharpfield.metrics.image import psnr, ssim, ssim_paper
from sharpfield.metrics.lpips import Lpips

MEASURES = {"psnr": psnr, "ssim": ssim, "ssim_paper": ssim_paper}
NAMES = (*MEASURES, "lpips")

HIGHEST_PSNR = 100.0
"""Equal images have an infinite PSNR, which no mean survives and no JSON holds."""

DEFINITIONS = {
    "psnr": f"dB, peak 1, over all pixels and channels of one view, at most {HIGHEST_PSNR:g}",
    "ssim": "Wang et al. 2004: Gaussian window 11x11 sigma 1.5, K1 0.01, K2 0.03, population"
    " covariance, range 1, per channel, windows inside the image",
    "ssim_paper": "as printed in papers on deblurring radiance fields: uniform window 7x7, sample"
    " covariance, images mapped to -1...1, range 2, per channel, windows inside the image",
}

Scores = dict[str, float | None]


def score(
    predicted: Float[Tensor, "h w c"], truth: Float[Tensor, "h w c"], lpips: Lpips | None = None
) -> Scores:
    """All numbers for one image in 0...1, display domain; None for LPIPS without weights."""
    found: Scores = {name: float(of(predicted, truth)) for name, of in MEASURES.items()}
    found["psnr"] = min(found["psnr"] or 0.0, HIGHEST_PSNR)
    found["lpips"] = None if lpips is None else float(lpips(_three(predicted), _three(truth)))
    return found


def mean(scores: Iterable[Mapping[str, float | None]]) -> Scores:
    """Mean of each number over images; None where a image lacks it, or without images."""
    scores = list(scores)
    columns = {name: [one[name] for one in scores] for name in NAMES}
    return {
        name: math.fsum(values) / len(values)  # pyright: ignore[reportArgumentType]
        if values and None not in values
        else None
        for name, values in columns.items()
    }


def _three(image: Float[Tensor, "h w c"]) -> Float[Tensor, "h w 3"]:
    return image.expand(-1, -1, 3)
