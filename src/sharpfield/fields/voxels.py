"""A field without networks: density and colour in dense voxel grids, static or moving.

It learns in a minute on a CPU what networks learn in an hour, and costs memory instead: no
detail finer than a voxel, and no colour that changes with the direction. Grids of several sizes
add up before the activations, so that the smooth part of the scene is held by few cells that many
rays pass. Moving grids hold the same at a number of moments, for those cells where something can
move; a static scene has none.

Source: direct voxel grids, DVGO (CVPR 2022) and Plenoxels (CVPR 2022); time as a fourth axis is
ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor, nn
from torch.nn import functional

from sharpfield.ops.grid import grid_shape
from sharpfield.ops.voxel_march import dense

COARSER = 4
"""Each grid has so many times fewer cells along an axis than the next finer one."""

FEWEST = 4
"""Fewest cells along an axis of space of the cubic grids; along time there are at least 2."""

LEVELS = 2
"""Grids of each kind."""


@dataclass(frozen=True)
class VoxelSizes:
    """Numbers of cells of the finest grids of a moving scene."""

    static: int = 48
    """Of the static grid, along each axis."""
    moving: int = 64
    """Of the moving grid, along each axis of space."""
    moments: int = 40
    """Of the moving grid, along time."""


def shapes_in(
    box: Float[Tensor, "2 3"], voxels: int, levels: int = LEVELS
) -> list[tuple[int, int, int]]:
    """Cells by z, y and x of static grids that fill a box with at most `voxels`, finest first."""
    counts = [voxels // COARSER ** (3 * level) for level in range(levels)]
    cells = [grid_shape(box, max(count, 8)) for count in counts]
    return [(z, y, x) for x, y, z in cells]


def static_shapes(sizes: VoxelSizes, levels: int = LEVELS) -> list[tuple[int, int, int]]:
    """Cells by z, y and x of the static grids of a moving scene, the finest first."""
    sides = [_coarser(sizes.static, level, FEWEST) for level in range(levels)]
    return [(side, side, side) for side in sides]


def moving_shapes(sizes: VoxelSizes, levels: int = LEVELS) -> list[tuple[int, int]]:
    """Moments, and cells along each axis of space, of the moving grids, the finest first."""
    return [
        (_coarser(sizes.moments, level, 2), _coarser(sizes.moving, level, FEWEST))
        for level in range(levels)
    ]


def _coarser(finest: int, level: int, least: int) -> int:
    return max(finest // COARSER**level, least)


class VoxelField(nn.Module):
    """Raw density and colour in a box, over a time from 0 to 1; all zero at first.

    Args:
        static: Cells by z, y and x of each static grid.
        occupied: For each moving grid, which cells `[t, d, h, w]` have values. The others stay
            zero: only the static grids count there.
        box: Low and high corner of the scene in the renderer's space; None for -1 to 1.
        raw_density: First raw density of the finest static grid; below zero, the scene starts
            nearly empty.
        background: Whether to learn a colour of the light from behind the box.
    """

    box: Float[Tensor, "2 3"] | None

    def __init__(
        self,
        static: Sequence[tuple[int, int, int]],
        occupied: Sequence[Bool[Tensor, "_ _ _ _"]] = (),
        *,
        box: Float[Tensor, "2 3"] | None = None,
        raw_density: float = 0.0,
        background: bool = False,
    ) -> None:
        super().__init__()
        self.register_buffer("box", None if box is None else box.float(), persistent=False)
        self.static = nn.ParameterList([torch.zeros(*shape, 4) for shape in static])
        self.moving = nn.ParameterList([torch.zeros(int(cells.sum()), 4) for cells in occupied])
        for level, cells in enumerate(occupied):
            counted = cells.flatten().cumsum(0).view(cells.shape) - 1
            rows = torch.where(cells, counted, -1).int()
            self.register_buffer(f"rows_{level}", rows, persistent=False)
        with torch.no_grad():
            self.static[0][..., 0] = raw_density
        self.behind = nn.Parameter(torch.zeros(3)) if background else None

    @property
    def rows(self) -> list[Int32[Tensor, "_ _ _ _"]]:
        """Rows of the values of moving cells, see `ops.voxel_march`."""
        return [self.get_buffer(f"rows_{level}") for level in range(len(self.moving))]

    def in_box(
        self, origin: Float[Tensor, "b 3"], direction: Float[Tensor, "b 3"]
    ) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]]:
        """Rays in box coordinates, -1 to 1."""
        if self.box is None:
            return origin, direction
        low, high = self.box
        scale = 2 / (high - low)
        return (origin - low) * scale - 1, direction * scale

    def fill(self, solid: Bool[Tensor, "t d h w"], raw_density: float) -> None:
        """Set the raw density of those cells of the finest moving grid that have values."""
        rows = self.rows[0][solid.to(self.static[0].device)]
        with torch.no_grad():
            self.moving[0][rows[rows >= 0].long(), 0] = raw_density

    def moments(
        self, first: int, count: int, level: int = 0
    ) -> tuple[Float[Tensor, "t d h w 4"], Bool[Tensor, "t d h w"]]:
        """Moving cells of some moments, and which of them have values."""
        rows = self.rows[level][first : first + count]
        return dense(self.moving[level], rows), rows >= 0

    def raw_density(self, points: Float[Tensor, "n 3"], time: float) -> Float[Tensor, "n"]:
        """Raw density at points in box coordinates, all at one time from 0 to 1."""
        grids = [grid[..., 0] for grid in self.static]
        for level, rows in enumerate(self.rows):
            at = time * (len(rows) - 1)
            first = min(int(at), len(rows) - 2)
            (before, after), _ = self.moments(first, 2, level)
            grids.append(before[..., 0].lerp(after[..., 0], at - first))
        at = points[None, None, None]  # [1, 1, 1, n, 3]
        found = [functional.grid_sample(grid[None, None], at, align_corners=True) for grid in grids]
        return torch.stack(found).sum(0)[0, 0, 0, 0]

    def background(self) -> Float[Tensor, "3"] | None:
        """Light from behind the box, 0...1, in all directions and at all times; None for black."""
        return None if self.behind is None else torch.sigmoid(self.behind)
