"""The metrics of single views: one object each, with its definition and how it is printed.

Other packages add theirs as entry points of the group `sharpfield.metrics`, each a `Metric`; it is
then computed for every view that is evaluated.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from sharpfield.core.plugins import Registry
from sharpfield.metrics.image import psnr, ssim, ssim_paper

HIGHEST_PSNR = 100.0
"""Reported for equal images: their PSNR is infinite, which neither a mean nor JSON can hold."""

Image = Float[Tensor, "h w c"]


@dataclass(frozen=True)
class Metric:
    """A number that compares a rendered view with its reference image."""

    name: str
    """Key in `metrics.json`."""
    title: str
    """Heading of its column in tables, with the unit."""
    definition: str
    """The settings that change the number; stored with it in `metrics.json`."""
    better: Literal["higher", "lower"]
    format: str
    """Format string for one value, such as `{:.2f}`."""
    compute: Callable[[Image, Image], float] | None = None
    """`compute(image, reference)`, both 0...1 in the display domain. None for LPIPS, which needs
    weight files: `with_lpips` puts them in."""

    def text(self, value: float | None) -> str:
        """The value as tables print it; a dash where there is none."""
        return "–" if value is None else self.format.format(value)

    def best(self, values: list[float]) -> float:
        """The best of some values."""
        return max(values) if self.better == "higher" else min(values)


METRICS = Registry(
    "sharpfield.metrics",
    {
        metric.name: metric
        for metric in (
            Metric(
                "psnr",
                "PSNR (dB)",
                f"dB, peak 1, over all pixels and channels of one view, at most {HIGHEST_PSNR:g}",
                "higher",
                "{:.2f}",
                lambda image, reference: min(float(psnr(image, reference)), HIGHEST_PSNR),
            ),
            Metric(
                "ssim",
                "SSIM",
                "Wang et al. 2004: Gaussian window 11x11 sigma 1.5, K1 0.01, K2 0.03, population"
                " covariance, range 1, per channel, windows inside the image",
                "higher",
                "{:.4f}",
                lambda image, reference: float(ssim(image, reference)),
            ),
            Metric(
                "ssim_paper",
                "SSIM (paper)",
                "as printed in papers on deblurring radiance fields: uniform window 7x7, sample"
                " covariance, images mapped to -1...1, range 2, per channel, windows inside the"
                " image",
                "higher",
                "{:.4f}",
                lambda image, reference: float(ssim_paper(image, reference)),
            ),
            Metric(
                "lpips",
                "LPIPS",
                "v0.1: distance of features of a network trained on ImageNet, averaged over layers"
                " and pixels; grey images are repeated in three channels",
                "lower",
                "{:.4f}",
            ),
        )
    },
)
"""Metrics by name, in the order of the columns of tables."""


def with_lpips(lpips: Callable[[Image, Image], Tensor]) -> Metric:
    """The metric `lpips`, computed with weights that `metrics.lpips.load_lpips` loaded."""
    return replace(
        METRICS["lpips"], compute=lambda image, reference: float(lpips(image, reference))
    )
