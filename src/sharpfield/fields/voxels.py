"""A field without networks: density and colour in a dense grid of voxels.

It learns in a minute on a CPU what networks learn in an hour, and costs memory instead: no
detail finer than a voxel, and no colour that changes with the direction.

Source: direct voxel grids, DVGO (CVPR 2022) and Plenoxels (CVPR 2022).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.ops.grid import grid_shape

COARSER = 4
"""Each grid has so many times fewer cells along an axis than the next."""


class VoxelGrid(nn.Module):
    """Raw density and colour at the cells of a box; all zero at first: thin grey fog.

    Grids of several sizes add up: what is smooth is learned by few cells that many rays pass.

    Args:
        box: Low and high corner of the scene in the renderer's space.
        voxels: Budget of cells of the finest grid.
        levels: How many grids.
    """

    box: Float[Tensor, "2 3"]

    def __init__(self, box: Float[Tensor, "2 3"], voxels: int, levels: int = 2) -> None:
        super().__init__()
        self.register_buffer("box", box.float(), persistent=False)
        budgets = [voxels // COARSER ** (3 * level) for level in range(levels)]
        shapes = [grid_shape(box, max(budget, 8))[::-1] for budget in budgets]
        self.grids = nn.ParameterList([torch.zeros(*shape, 4) for shape in shapes])

    def cells(self) -> list[nn.Parameter]:
        """The grids `[d, h, w, 4]`, the finest first."""
        return list(self.grids)

    def place(
        self, origin: Float[Tensor, "b 3"], direction: Float[Tensor, "b 3"]
    ) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]]:
        """Rays in box coordinates, -1 to 1."""
        low, high = self.box
        scale = 2 / (high - low)
        return (origin - low) * scale - 1, direction * scale
