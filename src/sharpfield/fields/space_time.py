"""A field over space and time without networks: voxels that stand still and voxels that move.

It learns in minutes on a processor. What stands still is a dense grid, as in `fields.voxel_grid`;
what moves is the same at a number of moments, coarser. Both add up before the activations, each
with a grid of few cells that many rays pass.

Source: direct voxel grids, DVGO (CVPR 2022), with time as a fourth axis.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

COARSER = 4
"""Each grid has so many times fewer cells along an axis than the next."""

THINNEST = 4
"""Fewest cells along an axis of space; along time there are at least 2."""


@dataclass(frozen=True)
class SpaceTimeSize:
    """Numbers of cells."""

    still: int = 48
    """Of what stands still, along each axis."""
    moving: int = 32
    """Of what moves, along each axis of space."""
    moments: int = 20
    """Of what moves, along time."""


class SpaceTimeVoxels(nn.Module):
    """Raw density and colour in a box from -1 to 1 and a time from 0 to 1; all zero at first.

    Args:
        size: Numbers of cells of the finest grids.
        levels: How many grids there are of each kind.
        clear: First raw density of the finest grid that stands still; below zero, the scene starts
            nearly empty.
    """

    def __init__(self, size: SpaceTimeSize, levels: int = 2, clear: float = 0.0) -> None:
        super().__init__()

        def cells(finest: int, level: int, least: int) -> int:
            return max(finest // COARSER**level, least)

        still = [cells(size.still, level, THINNEST) for level in range(levels)]
        self.still = nn.ParameterList([torch.zeros(n, n, n, 4) for n in still])
        moving = [
            (cells(size.moments, level, 2), cells(size.moving, level, THINNEST))
            for level in range(levels)
        ]
        self.moving = nn.ParameterList([torch.zeros(t, n, n, n, 4) for t, n in moving])
        with torch.no_grad():
            self.still[0][..., 0] = clear
        self.behind = nn.Parameter(torch.zeros(3))

    def freeze(self, level: int, where: Bool[Tensor, "d h w"]) -> None:
        """Keep moving voxels of a level at zero, where asked: only what stands still is there."""
        kept = (~where)[None, ..., None].float()
        self.register_buffer(f"free_{level}", kept, persistent=False)
        self.moving[level].register_hook(
            lambda gradient: gradient * self.get_buffer(f"free_{level}")
        )

    def raw_density(self, points: Float[Tensor, "n 3"], time: float) -> Float[Tensor, "n"]:
        """Raw density at points of the box, all at one time from 0 to 1."""
        grids = [*self.still]
        for grid in self.moving:
            at = time * (len(grid) - 1)
            first = min(int(at), len(grid) - 2)
            grids.append(grid[first].lerp(grid[first + 1], at - first))
        place = points[None, None, None]
        found = [
            functional.grid_sample(grid[None, None, ..., 0], place, align_corners=True)
            for grid in grids
        ]
        return torch.stack(found).sum(0)[0, 0, 0, 0]

    def background(self) -> Float[Tensor, "3"]:
        """Light from behind the box, 0...1: the same from everywhere and at all times."""
        return torch.sigmoid(self.behind)
