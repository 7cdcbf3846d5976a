# pyright: basic
"""Hash grids on the CPU: forwards one worker per point, backwards one worker per level.

A level's gradients are added by one worker, point after point, so sums do not depend on the number
of threads. That of the points adds the levels in order.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.hash_grid import PRIMES, HashLayout, hash_features

PRIME_Y, PRIME_Z = np.uint64(PRIMES[1]), np.uint64(PRIMES[2])


class _Levels(NamedTuple):
    """A `HashLayout` as kernels see it."""

    cells: np.ndarray
    entries: np.ndarray
    hashed: np.ndarray
    starts: np.ndarray


@hash_features.accelerate("cpu", needs="numba")
def _(
    points: Float[Tensor, "*b 3"], table: Float[Tensor, "n f"], layout: HashLayout
) -> Float[Tensor, "*b m"]:
    found = _HashFeatures.apply(points.reshape(-1, 3).contiguous(), table.contiguous(), layout)
    return found.reshape(*points.shape[:-1], found.shape[-1])


class _HashFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, layout: HashLayout) -> Tensor:
        ctx.save_for_backward(points, table)
        ctx.levels = _Levels(
            np.array(layout.cells),
            np.array(layout.entries),
            np.array(layout.hashed),
            np.array(layout.starts),
        )
        out = points.new_empty(len(points), len(layout.cells), table.shape[1])
        spread(_gather, memory(points), memory(table), ctx.levels, memory(out))
        return out.flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        points, table = ctx.saved_tensors
        grad = gradients[0].contiguous().reshape(len(points), -1, table.shape[1])
        of_points = of_table = None
        if ctx.needs_input_grad[0]:
            of_points = torch.zeros_like(points)
            arrays = memory(points), memory(table), ctx.levels, memory(grad), memory(of_points)
            spread(_slope, *arrays)
        if ctx.needs_input_grad[1]:
            of_table = np.zeros_like(memory(table))
            spread(_scatter, memory(points), ctx.levels, memory(grad), of_table)
            of_table = torch.from_numpy(of_table)
        return of_points, of_table, None


@kernel
def _locate_along(x, cells):
    """The cell below a place along one axis, and how far past it the place is."""
    place = ((-1.0 if x < -1.0 else 1.0 if x > 1.0 else x) + 1.0) * 0.5 * cells
    # Not a number stays one, in how far.
    low = min(int(place), cells - 1) if place == place else 0
    return low, place - low


@kernel
def _locate(point, cells):
    """The lowest corner of the cube around a point, and how far past it the point is."""
    x, past_x = _locate_along(point[0], cells)
    y, past_y = _locate_along(point[1], cells)
    z, past_z = _locate_along(point[2], cells)
    return (x, y, z), (past_x, past_y, past_z)


@kernel
def _entry(low, corner, levels, level):
    """Where a corner of a cube lies in the table; bit 2, 1, 0 of `corner` is x, y, z."""
    x, y, z = low[0] + (corner >> 2), low[1] + (corner >> 1 & 1), low[2] + (corner & 1)
    if levels.hashed[level]:
        mixed = np.uint64(x) ^ (np.uint64(y) * PRIME_Y) ^ (np.uint64(z) * PRIME_Z)
        return levels.starts[level] + np.int64(mixed % np.uint64(levels.entries[level]))
    row = levels.cells[level] + 1
    return levels.starts[level] + x + row * (y + row * z)


@kernel
def _factors(past, corner):
    """The factors of a corner's weight along x, y and z."""
    return (
        past[0] if corner >> 2 else 1.0 - past[0],
        past[1] if corner >> 1 & 1 else 1.0 - past[1],
        past[2] if corner & 1 else 1.0 - past[2],
    )


@kernel
def _gather(worker, workers, points, table, levels, out):
    """Write the features of a worker's points into `out [n, level, f]`."""
    number = out.dtype.type
    for point in range(*share(worker, workers, points.shape[0])):
        for level in range(levels.cells.shape[0]):
            low, past = _locate(points[point], levels.cells[level])
            out[point, level] = 0
            for corner in range(8):
                fx, fy, fz = _factors(past, corner)
                entry, weight = _entry(low, corner, levels, level), number(fx * fy * fz)
                for feature in range(table.shape[1]):
                    out[point, level, feature] += weight * table[entry, feature]


@kernel
def _scatter(worker, workers, points, levels, grad, out):
    """Add the gradients of a worker's levels to `out [n, f]`."""
    number = out.dtype.type
    for level in range(worker, levels.cells.shape[0], workers):
        for point in range(points.shape[0]):
            low, past = _locate(points[point], levels.cells[level])
            for corner in range(8):
                fx, fy, fz = _factors(past, corner)
                entry, weight = _entry(low, corner, levels, level), number(fx * fy * fz)
                for feature in range(out.shape[1]):
                    out[entry, feature] += weight * grad[point, level, feature]


@kernel
def _slope(worker, workers, points, table, levels, grad, out):
    """Write the gradients of a worker's points to `out [n, 3]`."""
    for point in range(*share(worker, workers, points.shape[0])):
        by_x = by_y = by_z = 0.0
        for level in range(levels.cells.shape[0]):
            low, past = _locate(points[point], levels.cells[level])
            scale = 0.5 * levels.cells[level]
            for corner in range(8):
                entry, arrived = _entry(low, corner, levels, level), 0.0
                for feature in range(table.shape[1]):
                    arrived += grad[point, level, feature] * table[entry, feature]
                fx, fy, fz = _factors(past, corner)
                by_x += arrived * scale * fy * fz * (1.0 if corner >> 2 else -1.0)
                by_y += arrived * scale * fx * fz * (1.0 if corner >> 1 & 1 else -1.0)
                by_z += arrived * scale * fx * fy * (1.0 if corner & 1 else -1.0)
        inside = np.abs(points[point]) <= 1.0
        out[point, 0] = by_x if inside[0] else 0.0
        out[point, 1] = by_y if inside[1] else 0.0
        out[point, 2] = by_z if inside[2] else 0.0
