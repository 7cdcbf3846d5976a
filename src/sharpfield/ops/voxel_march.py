"""Volume rendering of dense voxel grids of density and colour, static or changing with time.

A *static grid* `[d, h, w, 4]` holds raw density and raw colour at its cells, with trilinear
interpolation between them. Density is `softplus(raw + DENSITY_SHIFT)` per sample step, colour
`sigmoid(raw)`. Points are in box coordinates: -1 and 1 are the centres of the first and last cell
along x (w), y (h) and z (d); outside there is nothing.

A *moving grid* holds the same at moments evenly spaced over the time from -1 to 1, linear between
them. Most of its cells are empty at most moments, so it is stored sparsely: a table `[n, 4]` of
values, and the *row* of that table for each cell `[t, d, h, w]`, or -1 where all is zero. Static
and moving grids of any sizes add up before the activations.

Source: direct voxel grids, DVGO (CVPR 2022) for the activations, Plenoxels (CVPR 2022); time as a
fourth axis is ours.
"""

from collections.abc import Sequence
from functools import reduce

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int32
from torch import Tensor

from sharpfield.core.errors import ShapeError
from sharpfield.ops._dispatch import Op
from sharpfield.ops.compositing import gather, weights_of_opacities

DENSITY_SHIFT = -4.6
"""Added to raw density, so that an untrained grid absorbs about 1 % of the light per step."""


@Op
def march_voxels(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    depths: Float[Tensor, "b s"],
    static: Sequence[Float[Tensor, "_ _ _ 4"]],
    moving: Sequence[Float[Tensor, "_ 4"]] = (),
    rows: Sequence[Int32[Tensor, "_ _ _ _"]] = (),
    time: Float[Tensor, "b"] | None = None,
    *,
    opaque_end: bool = True,
) -> Float[Tensor, "b 5"]:
    """Red, green, blue, depth and opacity of rays.

    Args:
        origin: In box coordinates.
        direction: Change of the point, in box coordinates, per unit of depth.
        depths: Ray parameter of the samples, ascending; each stands for one step of length 1.
        static: Raw density, then raw colour, by z, y and x.
        moving: Values of the cells of each moving grid that have any.
        rows: Their rows by time, z, y and x; at least two moments.
        time: Of each ray, -1 to 1; needed when there are moving grids.
        opaque_end: The last sample absorbs all remaining light.

    Raises:
        ShapeError: There are moving grids but no times.
    """
    points = origin[:, None] + depths[..., None] * direction[:, None]  # [b, s, 3]
    values = [trilinear(grid, points) for grid in static]  # each [b, s, 4]
    for table, cells in zip(moving, rows, strict=True):
        if time is None:
            raise ShapeError("moving voxel grids need the time of each ray", do="pass time=[b]")
        values.append(_at_times(dense(table, cells), points, time))
    return _composite(reduce(torch.add, values), points, depths, opaque_end=opaque_end)


def trilinear(
    grid: Float[Tensor, "_ _ _ 4"], points: Float[Tensor, "b s 3"]
) -> Float[Tensor, "b s 4"]:
    """Interpolated values of a static grid; zero outside the box."""
    volume, at = grid.permute(3, 0, 1, 2)[None], points[None, None]  # [1, 4, d, h, w]
    found = F.grid_sample(volume, at, padding_mode="zeros", align_corners=True)  # [1, 4, 1, b, s]
    return found[0, :, 0].permute(1, 2, 0)


def dense(values: Float[Tensor, "n 4"], rows: Int32[Tensor, "*cells"]) -> Float[Tensor, "*cells 4"]:
    """A moving grid with all its cells: zero where they have no row."""
    return torch.cat([values.new_zeros(1, 4), values])[rows.long() + 1]


def _at_times(grid: Tensor, points: Tensor, time: Tensor) -> Float[Tensor, "b s 4"]:
    """Values of a moving grid, linear between the two moments around the time of each ray."""
    moment = (time.clamp(-1, 1) + 1) / 2 * (len(grid) - 1)
    first = moment.detach().long().clamp(max=len(grid) - 2)
    every = torch.stack([trilinear(volume, points) for volume in grid])  # [t, b, s, 4]
    ray = torch.arange(len(time), device=time.device)
    fraction = (moment - first)[:, None, None]
    return (1 - fraction) * every[first, ray] + fraction * every[first + 1, ray]


def _composite(
    raw: Float[Tensor, "b s 4"],
    points: Float[Tensor, "b s 3"],
    depths: Float[Tensor, "b s"],
    *,
    opaque_end: bool,
) -> Float[Tensor, "b 5"]:
    """Red, green, blue, depth and opacity, given the sum of all grids at the samples."""
    inside = (points.abs() <= 1).all(-1)  # [b, s]
    raw = raw * inside[..., None]
    alpha = (1 - torch.exp(-F.softplus(raw[..., 0] + DENSITY_SHIFT))) * inside
    if opaque_end:
        alpha = torch.cat([alpha[:, :-1], torch.ones_like(alpha[:, -1:])], -1)
    weights = weights_of_opacities(alpha)
    depth = (weights * depths).sum(-1, keepdim=True)
    colour = gather(weights, torch.sigmoid(raw[..., 1:]))
    return torch.cat([colour, depth, weights.sum(-1, keepdim=True)], -1)


@march_voxels.exemplify
def _example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    count = 6 * size

    def values(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    origin = torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, 1.1])
    direction = torch.tensor([0.0, 0.0, 1.5]) + 0.2 * values(count, 3)
    time = 2 * torch.rand(count, generator=generator) - 1
    depths = torch.rand(count, 12, generator=generator).sort(-1).values
    static = [2 * values(5, 6, 7, 4), 2 * values(3, 2, 4, 4)]
    full = torch.arange(2 * 3 * 2 * 2, dtype=torch.int32).view(2, 3, 2, 2)
    filled = torch.rand(5, 4, 5, 6, generator=generator) < 0.4
    numbers = filled.view(-1).cumsum(0).view(filled.shape) - 1
    rows = [torch.where(filled, numbers, -1).int(), full]
    moving = [2 * values(int(filled.sum()), 4), 2 * values(full.numel(), 4)]
    return origin, direction, depths, static, moving, rows, time
