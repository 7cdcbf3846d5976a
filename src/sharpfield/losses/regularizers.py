"""Terms that ask for something plausible where the measurements say too little."""

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
    """How far the first ray of a sparse kernel strays from the pixel it belongs to.

    Without it the scene may drift against the kernels, which then shift it back.

    Args:
        offset_px: Where each ray looks, relative to the pixel.
        origin: Shift of each ray's origin, world units.
        origin_factor: How much a unit of the second counts against a pixel of the first.

    Source: Deblur-NeRF (CVPR 2022), section 3.4; there with weight 0.1.
    """
    strayed = _length(offset_px[:, 0]) + origin_factor * _length(origin[:, 0])
    return strayed.mean()


def _length(vector: Float[Tensor, "b d"]) -> Float[Tensor, "b"]:
    """Euclidean, with a finite slope at zero."""
    return (vector.square().sum(-1) + 1e-12).sqrt()
