# pyright: basic
"""Total variation on the CPU: one pass over the grid for the value, one for the gradient.

A line is a plane of one row. A neighbour that is not there is the cell itself, so that their
difference vanishes.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import empty, kernel, memory, share, spread
from sharpfield.ops.fast._lanes import lanes_for, load, store, total, zeros
from sharpfield.ops.total_variation import total_variation


@total_variation.accelerate("cpu", needs="numba")
def _(grid: Float[Tensor, "*size c"]) -> Float[Tensor, ""]:
    if grid.ndim > 3:
        return total_variation.reference(grid)
    plane = grid.contiguous()
    return _TotalVariation.apply(plane if plane.ndim == 3 else plane[None])


class _TotalVariation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor) -> Tensor:
        ctx.save_for_backward(plane)
        sums = np.zeros((len(plane), 2))
        spread(_sum_squares, memory(plane), lanes_for(plane.shape[-1]), sums)
        down, right = sums.sum(0) * _scales(plane)
        return plane.new_tensor(down + right)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (plane,) = ctx.saved_tensors
        values = memory(plane)
        out = empty(plane, *plane.shape)
        scales = (2 * gradients[0].item() * _scales(plane)).astype(values.dtype)
        spread(_differentiate, values, lanes_for(plane.shape[-1]), scales, memory(out))
        return out


def _scales(plane: Tensor) -> np.ndarray:
    """2 / number of differences, along columns and along rows; 0 where there is none."""
    height, width, channels = plane.shape
    counts = np.array([(height - 1) * width, height * (width - 1)]) * channels
    return 2 * (counts > 0) / np.maximum(counts, 1)


@kernel
def _sum_squares(worker, workers, plane, lanes, sums):
    """Write the sums of squared differences downwards and rightwards, row by row."""
    height, width, channels = plane.shape
    for row in range(*share(worker, workers, height)):
        below = width * channels if row + 1 < height else 0
        downwards, rightwards = zeros(plane, lanes), zeros(plane, lanes)
        for column in range(width):
            right = channels if column + 1 < width else 0
            first = (row * width + column) * channels
            for at in range(first, first + channels, len(lanes)):
                here = load(plane, at, lanes)
                down, over = load(plane, at + below, lanes), load(plane, at + right, lanes)
                downwards += (down - here) * (down - here)
                rightwards += (over - here) * (over - here)
        sums[row, 0], sums[row, 1] = total(downwards), total(rightwards)


@kernel
def _differentiate(worker, workers, plane, lanes, scales, out):
    """Write the gradient: scale times the differences to the neighbours."""
    height, width, channels = plane.shape
    for row in range(*share(worker, workers, height)):
        above = width * channels if row > 0 else 0
        below = width * channels if row + 1 < height else 0
        for column in range(width):
            left = channels if column > 0 else 0
            right = channels if column + 1 < width else 0
            first = (row * width + column) * channels
            for at in range(first, first + channels, len(lanes)):
                here = load(plane, at, lanes)
                up, down = load(plane, at - above, lanes), load(plane, at + below, lanes)
                back, over = load(plane, at - left, lanes), load(plane, at + right, lanes)
                by_row = (here - up + (here - down)) * scales[0]
                by_column = (here - back + (here - over)) * scales[1]
                store(out, at, by_row + by_column)
