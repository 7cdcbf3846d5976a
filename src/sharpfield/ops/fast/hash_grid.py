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

from sharpfield.ops.fast._kernel import empty, kernel, memory, share, spread
from sharpfield.ops.fast._lanes import lanes_for, load, store, total, zeros
from sharpfield.ops.hash_grid import PRIMES, HashLayout, hash_features

BLOCK = 1024
"""Points whose features stay in the cache from level to level."""


class _Levels(NamedTuple):
    """A `HashLayout` as kernels see it."""

    cells: np.ndarray
    starts: np.ndarray
    strides: np.ndarray
    """`[level, 3]`: what a step along each axis adds, to a dense entry or before mixing."""
    masks: np.ndarray
    """Entries minus one where hashed, 0 where dense."""


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
        ctx.levels, ctx.lanes = _levels(layout), lanes_for(table.shape[1])
        out = empty(points, len(points), len(layout.cells), table.shape[1])
        spread(_gather, memory(points), memory(table), ctx.levels, ctx.lanes, memory(out))
        return out.flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        points, table = ctx.saved_tensors
        grad = gradients[0].contiguous().reshape(len(points), -1, table.shape[1])
        of_points = of_table = None
        if ctx.needs_input_grad[0]:
            of_points = torch.zeros_like(points)
            arrays = memory(points), memory(table), ctx.levels, ctx.lanes
            spread(_slope, *arrays, memory(grad), memory(of_points))
        if ctx.needs_input_grad[1]:
            of_table = np.zeros_like(memory(table))
            spread(_scatter, memory(points), ctx.levels, ctx.lanes, memory(grad), of_table)
            of_table = torch.from_numpy(of_table)
        return of_points, of_table, None


def _levels(layout: HashLayout) -> _Levels:
    dense = [(1, cells + 1, (cells + 1) ** 2) for cells in layout.cells]
    strides = [PRIMES if hashed else d for hashed, d in zip(layout.hashed, dense, strict=True)]
    sizes = np.array(layout.entries) - 1
    masks = np.where(layout.hashed, sizes, 0)
    return _Levels(np.array(layout.cells), np.array(layout.starts), np.array(strides), masks)


@kernel
def _locate(x, cells):
    """The cell below a place along one axis, and how far past it the place is."""
    place = ((-1.0 if x < -1.0 else 1.0 if x > 1.0 else x) + 1.0) * 0.5 * cells
    # Not a number stays one, in how far.
    low = min(int(place), cells - 1) if place == place else 0
    return low, place - low


@kernel
def _locate_all(points, point, cells):
    """The lowest corner of the cube around a point, and how far past it the point is."""
    x, past_x = _locate(points[point, 0], cells)
    y, past_y = _locate(points[point, 1], cells)
    z, past_z = _locate(points[point, 2], cells)
    return (x, y, z), (past_x, past_y, past_z)


@kernel
def _entry(low, corner, strides, mask):
    """Where a corner of a cube lies in its level; bits 2, 1, 0 of `corner` are x, y, z."""
    x = (low[0] + (corner >> 2)) * strides[0]
    y = (low[1] + (corner >> 1 & 1)) * strides[1]
    z = (low[2] + (corner & 1)) * strides[2]
    return (x ^ y ^ z) & mask if mask else x + y + z


@kernel
def _factors(past, corner):
    """The factors of a corner's weight along x, y and z."""
    return (
        past[0] if corner >> 2 else 1.0 - past[0],
        past[1] if corner >> 1 & 1 else 1.0 - past[1],
        past[2] if corner & 1 else 1.0 - past[2],
    )


@kernel
def _level(levels, level):
    """Cells, strides, mask and start of a level."""
    strides = (levels.strides[level, 0], levels.strides[level, 1], levels.strides[level, 2])
    return levels.cells[level], strides, levels.masks[level], levels.starts[level]


@kernel
def _gather(worker, workers, points, table, levels, lanes, out):
    """Write the features of a worker's points into `out [n, level, f]`."""
    first, stop = share(worker, workers, points.shape[0])
    number, count, features = out.dtype.type, out.shape[1], out.shape[2]
    for block in range(first, stop, BLOCK):
        for level in range(count):
            cells, strides, mask, start = _level(levels, level)
            for point in range(block, min(block + BLOCK, stop)):
                low, past = _locate_all(points, point, cells)
                for feature in range(0, features, len(lanes)):
                    found = zeros(table, lanes)
                    for corner in range(8):
                        fx, fy, fz = _factors(past, corner)
                        entry = start + _entry(low, corner, strides, mask)
                        row = load(table, entry * features + feature, lanes)
                        found += row * number(fx * fy * fz)
                    store(out, (point * count + level) * features + feature, found)


@kernel
def _scatter(worker, workers, points, levels, lanes, grad, out):
    """Add the gradients of a worker's levels to `out [n, f]`."""
    number, count, features = out.dtype.type, grad.shape[1], grad.shape[2]
    for level in range(worker, count, workers):
        cells, strides, mask, start = _level(levels, level)
        for point in range(points.shape[0]):
            low, past = _locate_all(points, point, cells)
            for feature in range(0, features, len(lanes)):
                arrived = load(grad, (point * count + level) * features + feature, lanes)
                for corner in range(8):
                    fx, fy, fz = _factors(past, corner)
                    entry = start + _entry(low, corner, strides, mask)
                    at = entry * features + feature
                    store(out, at, load(out, at, lanes) + arrived * number(fx * fy * fz))


@kernel
def _slope(worker, workers, points, table, levels, lanes, grad, out):
    """Add the gradients of a worker's points to `out [n, 3]`."""
    count, features = grad.shape[1], grad.shape[2]
    for point in range(*share(worker, workers, points.shape[0])):
        by_x = by_y = by_z = 0.0
        for level in range(count):
            cells, strides, mask, start = _level(levels, level)
            low, past = _locate_all(points, point, cells)
            for corner in range(8):
                entry = start + _entry(low, corner, strides, mask)
                dot = zeros(table, lanes)
                for feature in range(0, features, len(lanes)):
                    arrived = load(grad, (point * count + level) * features + feature, lanes)
                    dot += arrived * load(table, entry * features + feature, lanes)
                fx, fy, fz = _factors(past, corner)
                slope = total(dot) * 0.5 * cells
                by_x += slope * fy * fz * (1.0 if corner >> 2 else -1.0)
                by_y += slope * fx * fz * (1.0 if corner >> 1 & 1 else -1.0)
                by_z += slope * fx * fy * (1.0 if corner & 1 else -1.0)
        out[point, 0] = by_x if abs(points[point, 0]) <= 1.0 else 0.0
        out[point, 1] = by_y if abs(points[point, 1]) <= 1.0 else 0.0
        out[point, 2] = by_z if abs(points[point, 2]) <= 1.0 else 0.0
