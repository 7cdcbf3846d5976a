# pyright: basic
"""Plane and line lookups, and total variation, on the CPU.

Points are worked through in chunks whose taps and features stay in the CPU's cache, so that
mixing them costs no trip to memory. Nothing is kept for the backward pass but the arguments.

Total variation takes one pass over the grid for the value and one for the gradient. A line is a
plane of one row. A neighbour that does not exist is the cell itself, so that their difference is 0.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast import _grid_kernels as kernels
from sharpfield.ops.fast._kernel import empty, kernel, memory, share, spread
from sharpfield.ops.fast._lanes import lanes_for, load, store, total, zeros
from sharpfield.ops.grid import plane_line_features, plane_line_mixture, total_variation

CHUNK = 8192
"""Points at a time: 3 MB of 96 features."""


@plane_line_features.accelerate("cpu", needs="numba")
def _(
    points: Float[Tensor, "*b 3"],
    planes: Sequence[Float[Tensor, "_ _ _"]],
    lines: Sequence[Float[Tensor, "_ _"]],
) -> Float[Tensor, "*b f"]:
    return _look_up(points, None, planes, lines)


@plane_line_mixture.accelerate("cpu", needs="numba")
def _(
    points: Float[Tensor, "*b 3"],
    planes: Sequence[Float[Tensor, "_ _ _"]],
    lines: Sequence[Float[Tensor, "_ _"]],
    basis: Float[Tensor, "f m"],
) -> Float[Tensor, "*b m"]:
    return _look_up(points, basis.contiguous(), planes, lines)


def _look_up(
    points: Tensor, basis: Tensor | None, planes: Sequence[Tensor], lines: Sequence[Tensor]
) -> Tensor:
    grids = [grid.contiguous() for grid in (*planes, *lines)]
    found = _Lookup.apply(points.reshape(-1, 3).contiguous(), basis, *grids)
    return found.reshape(*points.shape[:-1], found.shape[-1])


class _Lookup(torch.autograd.Function):
    """Features of a volume, mixed by a basis if there is one."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, basis: Tensor | None, *grids: Tensor) -> Tensor:
        ctx.save_for_backward(points, basis, *grids)
        volume = _volume(grids)
        features = sum(plane.shape[2] for plane in volume.planes)
        out = empty(points, len(points), features if basis is None else basis.shape[1])
        tile = points.new_empty(CHUNK, features)
        for rows, taps in _chunks(points, volume):
            if basis is None:
                spread(kernels.gather, taps, volume, memory(out[rows]))
            else:
                part = tile[: rows.stop - rows.start]
                spread(kernels.gather, taps, volume, memory(part))
                torch.mm(part, basis, out=out[rows])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        points, basis, *grids = ctx.saved_tensors
        needs_points, needs_basis, *needs_grids = ctx.needs_input_grad
        # Empty points get no gradient, and in a scene that stands most points are empty.
        learning = gradients[0].any(1).nonzero()[:, 0]
        grad, volume = gradients[0][learning], _volume(grids)
        every, points = points, points[learning]
        of_grids = _zero_gradients(volume) if any(needs_grids) else None
        of_points = torch.zeros_like(points) if needs_points else None
        of_basis = torch.zeros_like(basis) if needs_basis else None
        tile = points.new_empty(CHUNK, grad.shape[1] if basis is None else len(basis))
        for rows, taps in _chunks(points, volume):
            arrived, part = grad[rows], tile[: rows.stop - rows.start]
            if of_basis is not None:
                spread(kernels.gather, taps, volume, memory(part))
                of_basis.addmm_(part.T, arrived)
            if basis is not None:
                arrived = torch.mm(arrived, basis.T, out=part)
            if of_grids is not None:
                spread(kernels.scatter, taps, volume, of_grids, memory(arrived))
            if of_points is not None:
                spread(kernels.slope, taps, volume, memory(arrived), memory(of_points[rows]))
        if of_points is not None:
            of_points = torch.zeros_like(every).index_copy(0, learning, of_points)
        return of_points, of_basis, *(_tensors(of_grids) if of_grids else [None] * len(grids))


def _volume(grids: Sequence[Tensor]) -> kernels.Volume:
    """Three planes and three lines as kernels see them."""
    views = [memory(grid) for grid in grids]
    lanes = lanes_for(*(view.shape[-1] for view in views))
    return kernels.Volume(tuple(views[:3]), tuple(views[3:]), lanes)


def _zero_gradients(volume: kernels.Volume) -> kernels.Gradients:
    bands = kernels.BANDS
    return kernels.Gradients(
        tuple(np.zeros_like(plane) for plane in volume.planes),
        tuple(np.zeros((bands, *line.shape), line.dtype) for line in volume.lines),
    )


def _tensors(gradients: kernels.Gradients) -> list[Tensor]:
    """The gradients of planes, then of lines."""
    lines = [bands.sum(0) for bands in gradients.lines]
    return [torch.from_numpy(table) for table in (*gradients.planes, *lines)]


def _chunks(points: Tensor, volume: kernels.Volume) -> Iterator[tuple[slice, kernels.Taps]]:
    """Walk through the points: which ones, and their taps."""
    shape = np.array([len(line) for line in reversed(volume.lines)])
    for start in range(0, len(points), CHUNK):
        rows = slice(start, min(start + CHUNK, len(points)))
        some = memory(points[rows])
        size = (len(some), 3, 2)
        weights, slopes = np.empty(size, some.dtype), np.empty(size, some.dtype)
        taps = kernels.Taps(np.empty(size, np.intp), weights, slopes)
        spread(kernels.locate, some, shape, taps)
        yield rows, taps


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
