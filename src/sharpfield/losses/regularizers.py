"""Regularization terms, for what the measurements leave undetermined."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.ops.grid import total_variation

SMOOTHNESS, OF_PLANES, OF_LINES = 5.0, 1e-2, 1e-3


def smoothness(
    planes: Iterable[Float[Tensor, "_h _w _c"]], lines: Iterable[Float[Tensor, "_l _c"]]
) -> Float[Tensor, ""]:
    """Total variation of factored feature volumes: 5 sum(0.01 tv(plane) + 0.001 tv(line)).

    Args:
        planes: Of all volumes, channels last.
        lines: Of all volumes, channels last.

    Source: PDRF (AAAI 2023), whose factors Ev-DeblurNeRF keeps.
    """
    terms = [OF_PLANES * total_variation(plane) for plane in planes]
    terms += [OF_LINES * total_variation(line) for line in lines]
    return SMOOTHNESS * torch.stack(terms).sum()


def alignment(
    offset_px: Float[Tensor, "b k 2"],
    origin: Float[Tensor, "b k 2"],
    *,
    origin_factor: float = 10.0,
) -> Float[Tensor, ""]:
    """Mean distance of the first ray of a sparse blur kernel from the pixel it belongs to.

    Without it the scene may be shifted while the kernels shift it back.

    Args:
        offset_px: Pixel position of each ray, relative to the pixel.
        origin: Shift of each ray's origin, world units.
        origin_factor: Weight of one world unit of `origin` against one pixel of `offset_px`.

    Source: Deblur-NeRF (CVPR 2022), section 3.4; there with weight 0.1.
    """
    distance = _length(offset_px[:, 0]) + origin_factor * _length(origin[:, 0])
    return distance.mean()


NEARLY = 1e-3
"""Confidences this close to 0 or 1 get no gradient."""


def indecision(confidence: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of log c + log(1 - c): highest at one half, so its descent leads to 0 or 1.

    Args:
        confidence: 0...1.

    Source: Point-NeRF (CVPR 2022), section 4.2, there with weight 1e-4.
    """
    if not len(confidence):
        return confidence.sum()
    bounded = confidence.clamp(NEARLY, 1 - NEARLY)
    return torch.mean(bounded.log() + (1 - bounded).log())


def _length(vector: Float[Tensor, "b d"]) -> Float[Tensor, "b"]:
    """Euclidean length, with a finite gradient at zero."""
    return (vector.square().sum(-1) + 1e-12).sqrt()
