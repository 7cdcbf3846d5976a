# pyright: basic
"""Marching through still and moving voxels on the CPU; see `fast.voxel_march` for the plan."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.fast._voxels import add, locate, look, sigmoid, softplus
from sharpfield.ops.fast.voxel_march import COLUMNS, DARK, FAINT, PARTS
from sharpfield.ops.space_time_march import march_through_time
from sharpfield.ops.voxel_march import THIN


@march_through_time.accelerate("cpu", needs="numba")
def _(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    time: Float[Tensor, "b"],
    place: Float[Tensor, "b s"],
    still: Sequence[Float[Tensor, "_ _ _ 4"]],
    moving: Sequence[Float[Tensor, "_ 4"]],
    rows: Sequence[Int32[Tensor, "_ _ _ _"]],
) -> Float[Tensor, "b 5"]:
    rays = (origin, direction, time, place)
    grids = (*still, *moving)
    if any(x.requires_grad for x in (origin, direction, place)) or any(
        grid.dtype != torch.float32 for grid in grids
    ):
        return march_through_time.reference(*rays, still, moving, rows)
    given = [x.contiguous() for x in rays]
    where = tuple(memory(x.contiguous()) for x in rows)
    return _March.apply(*given, where, *[grid.contiguous() for grid in grids])


class _March(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        origin: Tensor,
        direction: Tensor,
        time: Tensor,
        place: Tensor,
        where: tuple[np.ndarray, ...],
        *grids: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(origin, direction, time, place, *grids)
        ctx.where = where
        out = torch.empty(len(origin), 5)
        rays = tuple(memory(x) for x in (origin, direction, time, place))
        learning = any(ctx.needs_input_grad)
        traces = len(origin) if learning else torch.get_num_threads()
        trace = np.empty((traces, place.shape[1], COLUMNS), np.float32)
        kept = np.empty(len(origin), np.int64)
        spread(_forward, _field(grids, where), rays, learning, (trace, kept), memory(out))
        ctx.met = (trace, kept) if learning else None
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        origin, direction, time, place, *grids = ctx.saved_tensors
        rays = tuple(memory(x) for x in (origin, direction, time, place))
        sums = [np.zeros((PARTS, *grid.shape), np.float32) for grid in grids]
        still = len(grids) - len(ctx.where)
        parts = tuple(
            (tuple(s[k] for s in sums[:still]), tuple(s[k] for s in sums[still:]))
            for k in range(PARTS)
        )
        wanted = memory(gradients[0].contiguous())
        # Of no ray where nobody asks for the slope in time.
        slopes = torch.zeros(len(time) if ctx.needs_input_grad[2] else 0)
        lists = ctx.met, memory(slopes)
        spread(_backward, _field(grids, ctx.where), rays, lists, wanted, parts)
        for total in sums:
            spread(_merge, total.reshape(PARTS, -1))
        found = slopes if ctx.needs_input_grad[2] else None
        return None, None, found, None, None, *[torch.from_numpy(total[0]) for total in sums]


def _field(grids: Sequence[Tensor], where: tuple[np.ndarray, ...]) -> tuple[Any, ...]:
    """Still grids, and tables and rows of moving ones, as kernels see them."""
    views = [memory(grid) for grid in grids]
    still = len(views) - len(where)
    return tuple(views[:still]), tuple(views[still:]), where


@kernel
def _moment(rows, time):
    """The moment before a time, and the share of the next one."""
    at = (min(max(time, -1.0), 1.0) + 1.0) * 0.5 * (len(rows) - 1)
    first = min(int(at), len(rows) - 2)
    return first, np.float32(at - first)


@kernel
def _look_between(values, rows, first, later, corner, weight, found):
    """Add the values at a located point between two moments."""
    a, b, c, d = found[0], found[1], found[2], found[3]
    for t in range(2):
        wt = later if t else np.float32(1.0) - later
        for k in range(2):
            wz = wt * (weight[2] if k else np.float32(1.0) - weight[2])
            for j in range(2):
                wy = wz * (weight[1] if j else np.float32(1.0) - weight[1])
                for i in range(2):
                    row = rows[first + t, corner[2] + k, corner[1] + j, corner[0] + i]
                    if row >= 0:
                        w = wy * (weight[0] if i else np.float32(1.0) - weight[0])
                        cell = values[row]
                        a += w * cell[0]
                        b += w * cell[1]
                        c += w * cell[2]
                        d += w * cell[3]
    found[0], found[1], found[2], found[3] = a, b, c, d


@kernel
def _add_between(total, rows, first, later, corner, weight, slope):
    """Add to the sixteen cells around a located point, before and after its time."""
    a, b, c, d = slope
    for t in range(2):
        wt = later if t else np.float32(1.0) - later
        for k in range(2):
            wz = wt * (weight[2] if k else np.float32(1.0) - weight[2])
            for j in range(2):
                wy = wz * (weight[1] if j else np.float32(1.0) - weight[1])
                for i in range(2):
                    row = rows[first + t, corner[2] + k, corner[1] + j, corner[0] + i]
                    if row >= 0:
                        w = wy * (weight[0] if i else np.float32(1.0) - weight[0])
                        cell = total[row]
                        cell[0] += w * a
                        cell[1] += w * b
                        cell[2] += w * c
                        cell[3] += w * d


@kernel
def _slope_between(values, rows, first, corner, weight, slope):
    """How a loss grows with time at a located point, given how it does with what is found there."""
    a, b, c, d = slope
    grows = np.float32(0.0)
    for t in range(2):
        for k in range(2):
            wz = weight[2] if k else np.float32(1.0) - weight[2]
            for j in range(2):
                wy = wz * (weight[1] if j else np.float32(1.0) - weight[1])
                for i in range(2):
                    row = rows[first + t, corner[2] + k, corner[1] + j, corner[0] + i]
                    if row >= 0:
                        w = wy * (weight[0] if i else np.float32(1.0) - weight[0])
                        cell = values[row]
                        change = w * (a * cell[0] + b * cell[1] + c * cell[2] + d * cell[3])
                        grows += change if t else -change
    return grows * np.float32(0.5 * (len(rows) - 1))


@kernel
def _look_everywhere(field, x, y, z, time, scratch):
    """What all grids together hold at a point and a time; False outside."""
    found, corner, weight = scratch
    still, moving, rows = field
    found[:] = 0.0
    if not (-1.0 <= x <= 1.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 1.0):
        return False
    for level in range(len(still)):
        locate(still[level], x, y, z, corner, weight)
        look(still[level], corner, weight, found)
    for level in range(len(moving)):
        first, later = _moment(rows[level], time)
        locate(rows[level][0], x, y, z, corner, weight)
        _look_between(moving[level], rows[level], first, later, corner, weight, found)
    return True


@kernel
def _add_everywhere(field, point, time, scratch, slope, own, timed):
    """Add the gradient of what all grids hold at a point inside to that of their cells.

    Returns that of time, if it is `timed`.
    """
    _, corner, weight = scratch
    still, moving, rows = field
    x, y, z = point
    a, b, c, d = slope
    grows = np.float32(0.0)
    for level in range(len(still)):
        locate(still[level], x, y, z, corner, weight)
        add(own[0][level], corner, weight, a, b, c, d)
    for level in range(len(rows)):
        first, later = _moment(rows[level], time)
        locate(rows[level][0], x, y, z, corner, weight)
        _add_between(own[1][level], rows[level], first, later, corner, weight, slope)
        if timed:
            grows += _slope_between(moving[level], rows[level], first, corner, weight, slope)
    return grows


@kernel
def _point(rays, ray, z):
    origin, direction = rays[0], rays[1]
    return (
        origin[ray, 0] + z * direction[ray, 0],
        origin[ray, 1] + z * direction[ray, 1],
        origin[ray, 2] + z * direction[ray, 2],
    )


@kernel
def _walk(field, rays, ray, trace, scratch):
    """Fill the trace of one ray; returns how many samples it has. Columns: `voxel_march._walk`."""
    time, place = rays[2], rays[3]
    found = scratch[0]
    clear, kept = 1.0, 0
    for s in range(place.shape[1]):
        x, y, z = _point(rays, ray, place[ray, s])
        if not _look_everywhere(field, x, y, z, time[ray], scratch):
            if kept:
                break  # the box has no dents
            continue
        raw = found[0] + THIN
        alpha = 1.0 - math.exp(-softplus(raw))
        row = trace[kept]
        row[0], row[1], row[2], row[3] = s, alpha, clear * alpha, sigmoid(raw)
        if row[2] > FAINT:
            row[4], row[5], row[6] = sigmoid(found[1]), sigmoid(found[2]), sigmoid(found[3])
        else:
            row[4] = row[5] = row[6] = 0.0
        kept += 1
        clear *= 1.0 - alpha
        if clear < DARK:
            break
    return kept


@kernel
def _scratch():
    """Room for what was found at a point, and for the point located in a grid."""
    return np.empty(4, np.float32), np.empty(3, np.int64), np.empty(3, np.float32)


@kernel
def _forward(worker, workers, field, rays, learning, met, out):
    """Colour, depth and opacity of a share of the rays, and the samples that they met."""
    place = rays[3]
    traces, counts = met
    scratch = _scratch()
    for ray in range(*share(worker, workers, len(out))):
        trace = traces[ray if learning else worker]
        kept = _walk(field, rays, ray, trace, scratch)
        counts[ray] = kept
        red = green = blue = depth = opacity = 0.0
        for k in range(kept):
            w = trace[k, 2]
            red += w * trace[k, 4]
            green += w * trace[k, 5]
            blue += w * trace[k, 6]
            depth += w * place[ray, int(trace[k, 0])]
            opacity += w
        out[ray, 0], out[ray, 1], out[ray, 2] = red, green, blue
        out[ray, 3], out[ray, 4] = depth, opacity


@kernel
def _backward(worker, workers, field, rays, lists, wanted, parts):
    """Gradients of the grids; part after part, each into its own sum; those of times, if asked."""
    time, place = rays[2], rays[3]
    (traces, counts), slopes = lists
    timed = len(slopes) > 0
    scratch = _scratch()
    for part in range(worker, len(parts), workers):
        for ray in range(*share(part, len(parts), len(wanted))):
            g = wanted[ray]
            behind = 0.0  # sum over later samples of weight times what it adds to the loss
            for k in range(counts[ray] - 1, -1, -1):
                row = traces[ray, k]
                z = place[ray, int(row[0])]
                value = g[0] * row[4] + g[1] * row[5] + g[2] * row[6] + g[3] * z + g[4]
                front = row[2] / row[1] if row[1] > 0.0 else 0.0
                slope = (
                    np.float32(row[3] * (front * (1.0 - row[1]) * value - behind)),
                    np.float32(row[2] * g[0] * row[4] * (1.0 - row[4])),
                    np.float32(row[2] * g[1] * row[5] * (1.0 - row[5])),
                    np.float32(row[2] * g[2] * row[6] * (1.0 - row[6])),
                )
                behind += row[2] * value
                point = _point(rays, ray, z)
                grows = _add_everywhere(field, point, time[ray], scratch, slope, parts[part], timed)
                if timed and -1.0 <= time[ray] <= 1.0:
                    slopes[ray] += grows


@kernel
def _merge(worker, workers, sums):
    """Add all parts to the first."""
    first, last = share(worker, workers, sums.shape[1])
    for part in range(1, len(sums)):
        for i in range(first, last):
            sums[0, i] += sums[part, i]
