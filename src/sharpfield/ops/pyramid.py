"""Feature pyramids of images, sampled at pixels.

The *levels* of some images are maps `[n, h, w, f]`, channels last, the first of the images' own
size and the others of any size. A pixel of the image is sampled from every level, bilinearly with
clamping: equal to upsampling all maps to the size of the image first, but without storing them.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.ops._dispatch import Op


@Op
def sample_pyramid(
    xy: Float[Tensor, "m 2"],
    source: Int64[Tensor, "m"],
    levels: Sequence[Float[Tensor, "_n _h _w _f"]],
) -> Float[Tensor, "m f"]:
    """Features of all levels at pixels, concatenated.

    Args:
        xy: In pixels of the image, centres at +0.5.
        source: Index of the image of each pixel.
        levels: Of all images.
    """
    height, width = levels[0].shape[1:3]
    return torch.cat([_bilinear(level, source, xy, (height, width)) for level in levels], -1)


@sample_pyramid.exemplify
def _example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    shapes = ((7, 9, 3), (4, 5, 6), (2, 3, 12))
    levels = [torch.randn(3, *shape, generator=generator) for shape in shapes]
    xy = torch.rand(50 * size, 2, generator=generator) * torch.tensor([11.0, 9.0]) - 1
    source = torch.randint(0, 3, (50 * size,), generator=generator)
    return xy, source, levels


def _bilinear(
    level: Float[Tensor, "n h w f"],
    source: Int64[Tensor, "m"],
    xy: Float[Tensor, "m 2"],
    size: tuple[int, int],
) -> Float[Tensor, "m f"]:
    """One level at pixels of the image, whose height and width are `size`."""
    height, width = level.shape[1:3]
    rows = level.reshape(-1, level.shape[-1])
    at = xy * xy.new_tensor([width / size[1], height / size[0]]) - 0.5
    at = torch.minimum(at.clamp_min(0), at.new_tensor([width - 1, height - 1]))
    low = at.detach().floor()
    x, y = (at - low).unbind(-1)
    column, row = low.long().unbind(-1)
    right, below = (column + 1).clamp_max(width - 1), (row + 1).clamp_max(height - 1)
    base = source * height
    upper = rows[(base + row) * width + column] * (1 - x[:, None])
    upper = upper + rows[(base + row) * width + right] * x[:, None]
    lower = rows[(base + below) * width + column] * (1 - x[:, None])
    lower = lower + rows[(base + below) * width + right] * x[:, None]
    return upper * (1 - y[:, None]) + lower * y[:, None]
