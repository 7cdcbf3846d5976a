"""Image metrics: PSNR, SSIM in three definitions, sharpness without reference, event counts.

All functions take images `[h w c]` with values 0...1 in the display domain (as files store
them), compare them channel by channel, and compute in float64. SSIM comes in three settings that
give *different numbers for the same images*, so a table has to say which one it shows:

- `ssim`: the definition of Wang et al. 2004: a Gaussian window of 11x11 with sigma 1.5,
  population covariance, data range 1.
- `ssim_uniform`: scikit-image's default: a uniform window of 7x7, sample covariance, range 1.
- `ssim_paper`: the numbers printed by NeRF deblurring papers (Deblur-NeRF, DP-NeRF, PDRF,
  Ev-DeblurNeRF): as `ssim_uniform`, but of images mapped to -1...1 with range 2. Local means then
  lie around zero, and its luminance term punishes grey regions; it is often much lower.

Sharpness without a reference, `laplacian_variance` and `gradient_energy`, grows with contrast and
noise, too, so it orders images of the same scene under the same light, and means nothing on its
own. `relative_count_error` compares predicted with measured events by their counts at each pixel.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.errors import ShapeError
from sharpfield.core.tone import luma

Image = Float[Tensor, "h w c"]

K1, K2 = 0.01, 0.03
GAUSSIAN_WINDOW, GAUSSIAN_SIGMA = 11, 1.5
UNIFORM_WINDOW = 7


def psnr(predicted: Image, truth: Image) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite for equal images."""
    _same_shape(predicted, truth)
    return -10 * (predicted.double() - truth.double()).square().mean().log10()


def ssim(predicted: Image, truth: Image) -> Float[Tensor, ""]:
    """Structural similarity with a Gaussian window, as defined by its authors.

    Source: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to
    structural similarity", IEEE TIP 2004. Windows lie wholly inside the image.
    """
    offset = torch.arange(GAUSSIAN_WINDOW, dtype=torch.float64) - GAUSSIAN_WINDOW // 2
    window = (-0.5 * (offset / GAUSSIAN_SIGMA).square()).exp()
    return _ssim(predicted, truth, window / window.sum(), unbiased=1.0, data_range=1.0)


def ssim_uniform(predicted: Image, truth: Image) -> Float[Tensor, ""]:
    """Structural similarity with scikit-image's default window, on 0...1."""
    return _ssim(predicted, truth, *_uniform(), data_range=1.0)


def ssim_paper(predicted: Image, truth: Image) -> Float[Tensor, ""]:
    """Structural similarity as the papers on deblurring radiance fields print it."""
    return _ssim(predicted * 2 - 1, truth * 2 - 1, *_uniform(), data_range=2.0)


def _uniform() -> tuple[Float[Tensor, "t"], float]:
    """The window, and the factor from population to sample covariance."""
    count = UNIFORM_WINDOW**2
    window = torch.full((UNIFORM_WINDOW,), 1 / UNIFORM_WINDOW, dtype=torch.float64)
    return window, count / (count - 1)


def _ssim(
    predicted: Image,
    truth: Image,
    window: Float[Tensor, "t"],
    unbiased: float,
    *,
    data_range: float,
) -> Float[Tensor, ""]:
    """SSIM for any separable window; the border where it does not fit is left out."""
    _same_shape(predicted, truth)
    if min(truth.shape[:2]) < len(window):
        raise ShapeError(
            "image is smaller than the window of SSIM",
            got=f"{truth.shape[1]}x{truth.shape[0]} pixels, window {len(window)}",
            do="evaluate at a larger size",
        )
    x, y = predicted.double(), truth.double()
    window = window.to(x)
    mean_x, mean_y = _blur(x, window), _blur(y, window)
    variance_x = unbiased * (_blur(x * x, window) - mean_x * mean_x)
    variance_y = unbiased * (_blur(y * y, window) - mean_y * mean_y)
    covariance = unbiased * (_blur(x * y, window) - mean_x * mean_y)
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x.square() + mean_y.square() + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return (luminance * structure).mean()


def _blur(image: Image, window: Float[Tensor, "t"]) -> Float[Tensor, "y x c"]:
    """Separable weighted mean over windows that fit inside."""
    layers = image.permute(2, 0, 1)[:, None]  # [c, 1, h, w]
    layers = torch.nn.functional.conv2d(layers, window[None, None, :, None])
    layers = torch.nn.functional.conv2d(layers, window[None, None, None, :])
    return layers[:, 0].permute(1, 2, 0)


def _same_shape(predicted: Image, truth: Image) -> None:
    if predicted.shape != truth.shape:
        raise ShapeError(
            "images to compare have different shapes",
            got=f"{tuple(predicted.shape)} and {tuple(truth.shape)}",
        )


def laplacian_variance(image: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Variance of the Laplacian (four neighbours) of the luma, inside the border.

    Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    grey = luma(image).double()
    middle = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle
    return laplacian.var(correction=0)


def gradient_energy(image: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean squared length of the gradient of the luma, per pixel, by forward differences."""
    grey = luma(image).double()
    right = grey[:-1, 1:] - grey[:-1, :-1]
    down = grey[1:, :-1] - grey[:-1, :-1]
    return torch.mean(right.square() + down.square())


def relative_count_error(
    predicted: Float[Tensor, "*b h w"], measured: Float[Tensor, "*b h w"]
) -> Float[Tensor, ""]:
    """Sum of absolute differences of event counts over the number of measured events.

    0 is perfect; predicting no event at all gives 1. Infinite if nothing was measured.

    Args:
        predicted: Number of events at each pixel; give signs and time windows as leading axes,
            or errors of opposite sign hide each other.
        measured: The same for the recording.
    """
    return (predicted - measured).abs().sum() / measured.sum()
