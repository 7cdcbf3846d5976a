"""Total variation: how rough a grid of features is.

Source: TensoRF (ECCV 2022), the regulariser of its planes and lines; PDRF (AAAI 2023).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.ops._dispatch import Op


@Op
def total_variation(grid: Float[Tensor, "*size c"]) -> Float[Tensor, ""]:
    """Twice the mean squared difference of neighbours, summed over the axes of the grid.

    Args:
        grid: A plane `[h, w, c]` or a line `[l, c]`, channels last. An axis of one cell has no
            neighbours and adds nothing.
    """
    total = grid.new_zeros(())
    for axis, cells in enumerate(grid.shape[:-1]):
        if cells > 1:
            total = total + 2 * grid.diff(dim=axis).square().mean()
    return total


@total_variation.exemplify
def _example(generator: torch.Generator, size: int) -> tuple[Float[Tensor, "h w c"]]:
    return (torch.randn(7 * size, 5 * size, 6, generator=generator),)
