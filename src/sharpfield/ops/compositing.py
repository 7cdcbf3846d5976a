"""Volume rendering along a ray: density to weights, weights to colour, depth and opacity.

Vocabulary: a *sample* j represents a segment of the ray of length `delta`; its *alpha* = 1 -
exp(-density delta) is the share of light that it absorbs, its *weight* the share of the pixel's
light that comes from it. All functions work on any leading axes `*b` and on any device.

Source: NeRF (ECCV 2020), eq. 3; the small constant inside the transmittance and the opaque last
sample follow the released code of Deblur-NeRF, DP-NeRF and Ev-DeblurNeRF.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.ops._dispatch import Op

LEAK = 1e-10
"""Added to 1 - alpha of each sample, so that the transmittance never becomes zero."""

ENDLESS = 1e10
"""Length given to the last sample of a ray that has no end: any density there is opaque."""


@dataclass(frozen=True)
class Composited:
    """The result of compositing for rays."""

    rgb: Float[Tensor, "*b c"]
    depth: Float[Tensor, "*b"]
    """Weighted sum of the samples' depths; not divided by the opacity."""
    opacity: Float[Tensor, "*b"]
    """Sum of the weights, 0 to 1."""
    weights: Float[Tensor, "*b s"]


def gaps(
    depth: Float[Tensor, "*b s"], length: Float[Tensor, "*b"], *, last: float = ENDLESS
) -> Float[Tensor, "*b s"]:
    """Length of the segment of each point sample: from itself to the next one.

    Args:
        depth: Ray parameter of the samples, ascending.
        length: Length of the ray's direction, e.g. in normalised device coordinates.
        last: Length, in ray parameter, of the last segment, which has no end.
    """
    end = torch.full_like(depth[..., :1], last)
    return torch.cat([depth.diff(dim=-1), end], -1) * length[..., None]


def opacities(
    density: Float[Tensor, "*b s"], delta: Float[Tensor, "*b s"], *, opaque_end: bool = False
) -> Float[Tensor, "*b s"]:
    """Alpha of each sample: 1 - exp(-density delta).

    Args:
        density: Not negative.
        delta: Length of each segment.
        opaque_end: The last sample absorbs everything (the far end of normalised device
            coordinates is at infinity).
    """
    alpha = 1 - torch.exp(-density * delta)
    if not opaque_end:
        return alpha
    return torch.cat([alpha[..., :-1], torch.ones_like(alpha[..., -1:])], -1)


def weights_of_opacities(alpha: Float[Tensor, "*b s"]) -> Float[Tensor, "*b s"]:
    """Weights of samples: w_j = alpha_j prod_{k<j} (1 - alpha_k + 1e-10) (NeRF eq. 3)."""
    first = torch.ones_like(alpha[..., :1])
    transmittance = torch.cat([first, 1 - alpha[..., :-1] + LEAK], -1).cumprod(-1)
    return alpha * transmittance


@Op
def weigh(
    density: Float[Tensor, "*b s"], delta: Float[Tensor, "*b s"], *, opaque_end: bool = False
) -> Float[Tensor, "*b s"]:
    """Weights of the samples, without colour: `weights_of_opacities(opacities(...))`.

    Call this first where the colour of samples of negligible weight is to be skipped, see
    `gather_kept`.
    """
    return weights_of_opacities(opacities(density, delta, opaque_end=opaque_end))


@weigh.exemplify
def _(generator: torch.Generator, size: int) -> tuple[Tensor, Tensor]:
    """64 rays, or 18432 at size 288, of 192 samples."""
    shape = (64 * size, 192)
    density = 40 * torch.rand(shape, generator=generator)
    return density, torch.rand(shape, generator=generator) / shape[1]


def gather(weights: Float[Tensor, "*b s"], value: Float[Tensor, "*b s c"]) -> Float[Tensor, "*b c"]:
    """Sum of the samples' values by weight."""
    return (weights[..., None, :] @ value).squeeze(-2)


def gather_kept(
    weights: Float[Tensor, "b s"], kept: Int64[Tensor, " n"], value: Float[Tensor, "n c"]
) -> Float[Tensor, "b c"]:
    """Sum by weight when only `n` samples have a value; the rest are zero.

    Args:
        weights: Of all samples.
        kept: Flat indices of the samples whose value was computed, one ray after the other.
        value: Of these samples.
    """
    rays, samples = weights.shape
    light = weights.flatten().index_select(0, kept)[:, None] * value
    return value.new_zeros(rays, value.shape[-1]).index_add(0, kept // samples, light)


def composite(
    density: Float[Tensor, "*b s"],
    delta: Float[Tensor, "*b s"],
    colour: Float[Tensor, "*b s c"],
    depth: Float[Tensor, "*b s"],
    *,
    opaque_end: bool = False,
) -> Composited:
    """Weights, colour, depth and opacity of rays.

    Args:
        density: Not negative, per unit of `delta`.
        delta: Length of each segment, e.g. `edges.diff(dim=-1)` or `gaps(...)`.
        colour: Linear; any number of channels.
        depth: Ray parameter of each sample.
        opaque_end: See `opacities`.
    """
    weights = weigh(density, delta, opaque_end=opaque_end)
    return Composited(
        rgb=gather(weights, colour),
        depth=(weights * depth).sum(-1),
        opacity=weights.sum(-1),
        weights=weights,
    )
