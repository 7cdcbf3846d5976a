"""Numbers to report, never to train on."""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.metrics.image import laplacian_variance as laplacian_variance
    from sharpfield.metrics.image import psnr as psnr
    from sharpfield.metrics.image import ssim as ssim
    from sharpfield.metrics.lpips import load_lpips as load_lpips
    from sharpfield.metrics.pose import absolute_error as absolute_error
    from sharpfield.metrics.pose import relative_error as relative_error

__getattr__, __dir__ = lazily(__name__, __file__, check_shapes=True)
