"""Light along rays through a dense grid of density and colour, with no network at all.

A *voxel grid* `[d, h, w, 4]` holds raw density and raw colour at its cells; between cells both are
trilinear. Density is `softplus(raw + THIN)` per sample step, colour `sigmoid(raw)`. Points are in
box coordinates: -1 and 1 are the centres of the first and last cell along x (w), y (h) and z (d);
outside there is nothing.

Source: direct voxel grids, DVGO (CVPR 2022) for the activations, Plenoxels (CVPR 2022).
"""

from collections.abc import Sequence
from functools import reduce

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sharpfield.ops._dispatch import Op
from sharpfield.ops.composite import gather, weights_of_opacities

THIN = -4.6
"""Added to raw density: an untrained grid stops about a hundredth of the light per step."""


@Op
def march(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    place: Float[Tensor, "b s"],
    grids: Sequence[Float[Tensor, "_ _ _ 4"]],
    *,
    opaque_end: bool = True,
) -> Float[Tensor, "b 5"]:
    """Red, green, blue, depth and opacity of rays.

    Args:
        origin: In box coordinates.
        direction: Of one unit of `place`, in box coordinates.
        place: Ray parameter of the samples, ascending; each stands for one step of length 1.
        grids: Raw density, then raw colour; grids of several sizes add up.
        opaque_end: The last sample stops all light.
    """
    points = origin[:, None] + place[..., None] * direction[:, None]
    raw = reduce(torch.add, [trilinear(grid, points) for grid in grids])
    return light_of(raw, points, place, opaque_end=opaque_end)


def trilinear(
    grid: Float[Tensor, "_ _ _ 4"], points: Float[Tensor, "b s 3"]
) -> Float[Tensor, "b s 4"]:
    """Values between the cells."""
    image, at = grid.permute(3, 0, 1, 2)[None], points[None, None]
    found = F.grid_sample(image, at, padding_mode="zeros", align_corners=True)
    return found[0, :, 0].permute(1, 2, 0)


def light_of(
    raw: Float[Tensor, "b s 4"],
    points: Float[Tensor, "b s 3"],
    place: Float[Tensor, "b s"],
    *,
    opaque_end: bool,
) -> Float[Tensor, "b 5"]:
    """Red, green, blue, depth and opacity, given what all grids together hold at the samples."""
    inside = (points.abs() <= 1).all(-1)
    raw = raw * inside[..., None]
    alpha = (1 - torch.exp(-F.softplus(raw[..., 0] + THIN))) * inside
    if opaque_end:
        alpha = torch.cat([alpha[:, :-1], torch.ones_like(alpha[:, -1:])], -1)
    weights = weights_of_opacities(alpha)
    depth = (weights * place).sum(-1, keepdim=True)
    colour = gather(weights, torch.sigmoid(raw[..., 1:]))
    return torch.cat([colour, depth, weights.sum(-1, keepdim=True)], -1)


@march.exemplify
def _example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    count = 6 * size
    grids = [2 * torch.randn(*shape, 4, generator=generator) for shape in ((5, 6, 7), (3, 2, 4))]
    start = torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, 1.1])
    toward = torch.tensor([0.0, 0.0, 1.5]) + 0.2 * torch.randn(count, 3, generator=generator)
    place = torch.rand(count, 12, generator=generator).sort(-1).values
    return start, toward, place, grids
