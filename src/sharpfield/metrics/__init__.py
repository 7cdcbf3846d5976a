"""Numbers to report, never to train on."""

from sharpfield.metrics.event_blur import event_blur
from sharpfield.metrics.events import relative_count_error
from sharpfield.metrics.image import psnr, ssim, ssim_paper, ssim_uniform
from sharpfield.metrics.lpips import Lpips, load_lpips
from sharpfield.metrics.pose import absolute_error, align, relative_error
from sharpfield.metrics.quality import Quality, event_quality, quality, quality_weights
from sharpfield.metrics.sharpness import gradient_energy, laplacian_variance, luma

__all__ = [
    "Lpips",
    "Quality",
    "absolute_error",
    "align",
    "event_blur",
    "event_quality",
    "gradient_energy",
    "laplacian_variance",
    "load_lpips",
    "luma",
    "psnr",
    "quality",
    "quality_weights",
    "relative_count_error",
    "relative_error",
    "ssim",
    "ssim_paper",
    "ssim_uniform",
]
