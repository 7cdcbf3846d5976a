"""A field over space and time without networks: voxels that stand still and voxels that move.

It learns in minutes on a CPU. What stands still is a dense grid, as in `fields.voxel_grid`;
what moves is the same at a number of moments, for those cells where something can move. Both add
up before the activations, each with a grid of few cells that many rays pass.

Source: direct voxel grids, DVGO (CVPR 2022), with time as a fourth axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor, nn
from torch.nn import functional

from sharpfield.ops.space_time_march import spread_out

COARSER = 4
"""Each grid has so many times fewer cells along an axis than the next."""

THINNEST = 4
"""Fewest cells along an axis of space; along time there are at least 2."""


@dataclass(frozen=True)
class SpaceTimeSize:
    """Numbers of cells."""

    still: int = 48
    """Of what stands still, along each axis."""
    moving: int = 64
    """Of what moves, along each axis of space."""
    moments: int = 40
    """Of what moves, along time."""


def moving_shapes(size: SpaceTimeSize, levels: int = 2) -> list[tuple[int, int]]:
    """Moments and cells along each axis of space of the moving grids, the finest first."""
    return [
        (_coarser(size.moments, level, 2), _coarser(size.moving, level, THINNEST))
        for level in range(levels)
    ]


class SpaceTimeVoxels(nn.Module):
    """Raw density and colour in a box from -1 to 1 and a time from 0 to 1; all zero at first.

    Args:
        size: Numbers of cells of the finest grids.
        where: For each moving grid, the cells that have values; None for all. Others stay zero:
            only what stands still is there.
        clear: First raw density of the finest grid that stands still; below zero, the scene starts
            nearly empty.
        levels: How many grids there are of each kind.
    """

    def __init__(
        self,
        size: SpaceTimeSize,
        where: Sequence[Bool[Tensor, "_ _ _ _"]] | None = None,
        clear: float = 0.0,
        levels: int = 2,
    ) -> None:
        super().__init__()
        still = [_coarser(size.still, level, THINNEST) for level in range(levels)]
        self.still = nn.ParameterList([torch.zeros(n, n, n, 4) for n in still])
        if where is None:
            where = [torch.ones(t, n, n, n).bool() for t, n in moving_shapes(size, levels)]
        self.moving = nn.ParameterList([torch.zeros(int(cells.sum()), 4) for cells in where])
        for level, cells in enumerate(where):
            counted = cells.flatten().cumsum(0).view(cells.shape) - 1
            rows = torch.where(cells, counted, -1).int()
            self.register_buffer(f"rows_{level}", rows, persistent=False)
        with torch.no_grad():
            self.still[0][..., 0] = clear
        self.behind = nn.Parameter(torch.zeros(3))

    @property
    def rows(self) -> list[Int32[Tensor, "_ _ _ _"]]:
        """Where the values of moving cells are, see `ops.space_time_march`."""
        return [self.get_buffer(f"rows_{level}") for level in range(len(self.moving))]

    def fill(self, solid: Bool[Tensor, "t d h w"], density: float) -> None:
        """Set the raw density of those cells of the finest moving grid that have values."""
        rows = self.rows[0][solid.to(self.behind.device)]
        with torch.no_grad():
            self.moving[0][rows[rows >= 0].long(), 0] = density

    def moments(
        self, first: int, count: int, level: int = 0
    ) -> tuple[Float[Tensor, "t d h w 4"], Bool[Tensor, "t d h w"]]:
        """Moving cells of some moments, and which of them have values."""
        rows = self.rows[level][first : first + count]
        return spread_out(self.moving[level], rows), rows >= 0

    def raw_density(self, points: Float[Tensor, "n 3"], time: float) -> Float[Tensor, "n"]:
        """Raw density at points of the box, all at one time from 0 to 1."""
        grids = [grid[..., 0] for grid in self.still]
        for level, rows in enumerate(self.rows):
            at = time * (len(rows) - 1)
            first = min(int(at), len(rows) - 2)
            (before, after), _ = self.moments(first, 2, level)
            grids.append(before[..., 0].lerp(after[..., 0], at - first))
        place = points[None, None, None]
        found = [
            functional.grid_sample(grid[None, None], place, align_corners=True) for grid in grids
        ]
        return torch.stack(found).sum(0)[0, 0, 0, 0]

    def background(self) -> Float[Tensor, "3"]:
        """Light from behind the box, 0...1: the same from everywhere and at all times."""
        return torch.sigmoid(self.behind)


def _coarser(finest: int, level: int, least: int) -> int:
    return max(finest // COARSER**level, least)
