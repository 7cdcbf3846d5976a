"""Light along rays through voxels, some of which stand still while others change with time.

A *moving grid* holds raw density and raw colour at moments evenly spread over the time from -1 to
1; between them it is linear. Most of its cells are empty at most moments, so that only some have
values: a table `[n, 4]` of these, and for each cell `[t, d, h, w]` its *row* there, or -1 where all
is zero. Moving and still grids (see `ops.voxel_march`) of any sizes add up. Points are in box
coordinates, -1 to 1; outside there is nothing.

Source: DVGO (CVPR 2022) for voxels and activations, with time as a fourth axis.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from sharpfield.ops._dispatch import Op
from sharpfield.ops.voxel_march import light_of, trilinear


@Op
def march_through_time(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    time: Float[Tensor, "b"],
    place: Float[Tensor, "b s"],
    still: Sequence[Float[Tensor, "_ _ _ 4"]],
    moving: Sequence[Float[Tensor, "_ 4"]],
    rows: Sequence[Int32[Tensor, "_ _ _ _"]],
) -> Float[Tensor, "b 5"]:
    """Red, green, blue, depth and opacity of rays.

    Args:
        origin: In box coordinates.
        direction: Of one unit of `place`, in box coordinates.
        time: Of each ray, -1 to 1.
        place: Ray parameter of the samples, ascending; each stands for one step of length 1.
        still: Raw density and raw colour, by z, y and x.
        moving: Values of moving cells, one table for each grid.
        rows: Of moving cells, by time, z, y and x; at least two moments.
    """
    points = origin[:, None] + place[..., None] * direction[:, None]
    found = [trilinear(grid, points) for grid in still]
    found += [
        _through_time(spread_out(values, at), points, time)
        for values, at in zip(moving, rows, strict=True)
    ]
    return light_of(torch.stack(found).sum(0), points, place, opaque_end=False)


def spread_out(
    values: Float[Tensor, "n 4"], rows: Int32[Tensor, "*cells"]
) -> Float[Tensor, "*cells 4"]:
    """A grid with all its cells: zero where they have no row."""
    return torch.cat([values.new_zeros(1, 4), values])[rows.long() + 1]


def _through_time(grid: Tensor, points: Tensor, time: Tensor) -> Float[Tensor, "b s 4"]:
    """Between the two moments around the time of each ray."""
    at = (time.clamp(-1, 1) + 1) / 2 * (len(grid) - 1)
    first = at.detach().long().clamp(max=len(grid) - 2)
    every = torch.stack([trilinear(moment, points) for moment in grid])  # [t, b, s, 4]
    ray = torch.arange(len(time), device=time.device)
    later = (at - first)[:, None, None]
    return (1 - later) * every[first, ray] + later * every[first + 1, ray]


@march_through_time.exemplify
def _example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    count = 6 * size

    def values(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    start = torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, 1.1])
    toward = torch.tensor([0.0, 0.0, 1.5]) + 0.2 * values(count, 3)
    time = 2 * torch.rand(count, generator=generator) - 1
    place = torch.rand(count, 12, generator=generator).sort(-1).values
    still = [2 * values(5, 6, 7, 4), 2 * values(3, 2, 4, 4)]
    whole = torch.arange(2 * 3 * 2 * 2, dtype=torch.int32).view(2, 3, 2, 2)
    some = torch.rand(5, 4, 5, 6, generator=generator) < 0.4
    rows = [torch.where(some, some.view(-1).cumsum(0).view(some.shape) - 1, -1).int(), whole]
    moving = [2 * values(int(some.sum()), 4), 2 * values(whole.numel(), 4)]
    return start, toward, time, place, still, moving, rows
