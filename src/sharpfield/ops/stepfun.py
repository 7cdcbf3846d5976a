"""Piecewise-constant functions along a ray, and importance sampling from them.

Vocabulary: `depth [*b s]` are points of a ray in ascending order; `edges [*b s+1]` bound s
intervals; `weights [*b s]` are the shares of the ray's light, see `ops.compositing`. A *position*
is a quantile, 0 to 1, of the cumulative weight at which a new sample is placed. New samples carry
no gradient: they must not move to change the rendered light.

Source: NeRF (ECCV 2020), section 5.2.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

FLOOR = 1e-5
"""Added to the weights before sampling, so that every part of a ray can be sampled."""

LEAST_BIN = 1e-5
"""Weight of a bin below which it is not divided by."""


def random_positions(
    leading: Sequence[int], count: int, generator: torch.Generator
) -> Float[Tensor, "*b m"]:
    """Independent uniform positions, unsorted: training of NeRF and its successors."""
    return torch.rand(*leading, count, generator=generator, device=generator.device)


def even_positions(
    leading: Sequence[int], count: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "*b m"]:
    """Evenly spaced positions from 0 to 1 inclusive: evaluation."""
    return torch.linspace(0, 1, count, device=device).expand(*leading, count)


def stratified_positions(
    leading: Sequence[int], count: int, generator: torch.Generator
) -> Float[Tensor, "*b m"]:
    """One uniform position in each of `count` equal bins, ascending."""
    start = torch.arange(count, device=generator.device)
    return (start + random_positions(leading, count, generator)) / count


def midpoints(depth: Float[Tensor, "*b s"]) -> Float[Tensor, "*b m"]:
    """Midpoints of neighbours; m = s - 1."""
    return (depth[..., 1:] + depth[..., :-1]) / 2


def jitter(depth: Float[Tensor, "*b s"], amount: Float[Tensor, "*b s"]) -> Float[Tensor, "*b s"]:
    """Move each point inside its own bin, which reaches half way to its neighbours.

    The first and the last point have half a bin: nothing leaves the range of `depth`.

    Args:
        depth: Ascending.
        amount: New position of each point in its bin, 0 to 1; `random_positions` in training.
    """
    middle = midpoints(depth)
    lower = torch.cat([depth[..., :1], middle], -1)
    upper = torch.cat([middle, depth[..., -1:]], -1)
    return lower + (upper - lower) * amount


@torch.no_grad()
def invert(
    edges: Float[Tensor, "*b e"], weights: Float[Tensor, "*b s"], position: Float[Tensor, "*b m"]
) -> Float[Tensor, "*b m"]:
    """Inverse of the cumulative weight, with weight uniform within each interval.

    Args:
        edges: Ascending; e = s + 1.
        weights: At least one above zero on each ray; they need not sum to one.
        position: 0 to 1.
    """
    pdf = weights / weights.sum(-1, keepdim=True)
    cdf = torch.cat([torch.zeros_like(pdf[..., :1]), pdf.cumsum(-1)], -1).contiguous()  # [*b, e]
    right = torch.searchsorted(cdf, position.contiguous(), right=True)
    below, above = (right - 1).clamp(min=0), right.clamp(max=edges.shape[-1] - 1)
    low, high = cdf.gather(-1, below), cdf.gather(-1, above)
    start, end = edges.gather(-1, below), edges.gather(-1, above)
    gap = high - low
    gap = torch.where(gap < LEAST_BIN, torch.ones_like(gap), gap)
    return start + (position - low) / gap * (end - start)


@torch.no_grad()
def resample_points(
    depth: Float[Tensor, "*b s"], weights: Float[Tensor, "*b s"], position: Float[Tensor, "*b m"]
) -> Float[Tensor, "*b m"]:
    """New points by importance; the bins are between midpoints of the old points.

    The first and the last weight belong to half bins and are left out, as in the released NeRF and
    its successors.

    Args:
        depth: Ascending, at least three.
        weights: Of those points.
        position: From `random_positions` in training, `even_positions` in evaluation.
    """
    return invert(midpoints(depth), weights[..., 1:-1] + FLOOR, position)


@torch.no_grad()
def merge(
    first: Float[Tensor, "*b s"], second: Float[Tensor, "*b m"]
) -> tuple[Float[Tensor, "*b t"], Int[Tensor, "*b t"]]:
    """Both sets in ascending order, and the index of each in `cat([first, second])`.

    With the order, a network can process the samples unsorted, and only its few outputs are
    permuted, by `take_along`.
    """
    depth, order = torch.cat([first, second], -1).sort(dim=-1, stable=True)
    return depth, order


def take_along(value: Float[Tensor, "*b t c"], order: Int[Tensor, "*b t"]) -> Tensor:
    """`value` with its samples in the given order."""
    count = value.shape[-2]
    rays = value.shape[:-2].numel()
    row = order.reshape(rays, count) + count * torch.arange(rays, device=order.device)[:, None]
    # Whole rows at once: several times as fast as a gather of single numbers.
    return value.reshape(-1, value.shape[-1]).index_select(0, row.flatten()).reshape(value.shape)
