# pyright: basic
"""Marching through still and moving voxels on the CPU; see `fast.voxel_march` for the plan."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.fast._lanes import load, store, total
from sharpfield.ops.fast._trace import DARK, PARTS, gather, merge, note, room_for_traces, slopes
from sharpfield.ops.fast._voxels import (
    FOUR,
    add,
    corner,
    inside,
    locate,
    look,
    new_spot,
    point_on,
    share_of_corner,
)
from sharpfield.ops.space_time_march import march_through_time


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
        met = room_for_traces(*place.shape, learning=learning)
        spread(_forward, _field(grids, where), rays, learning, met, memory(out))
        ctx.met = met if learning else None
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
        of_time = torch.zeros(len(time) if ctx.needs_input_grad[2] else 0)
        lists = ctx.met, memory(of_time)
        spread(_backward, _field(grids, ctx.where), rays, lists, wanted, parts)
        for whole in sums:
            spread(merge, whole.reshape(PARTS, -1))
        found = of_time if ctx.needs_input_grad[2] else None
        return None, None, found, None, None, *[torch.from_numpy(whole[0]) for whole in sums]


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
def _look_between(moving, rows, point, time, spot):
    """Add what moving grids hold at a point and a time to the values of a spot."""
    for level in range(len(moving)):
        first, later = _moment(rows[level], time)
        locate(rows[level][0], point, spot)
        found = load(spot[0], 0, FOUR)
        for t in range(2):
            whole = later if t else np.float32(1.0) - later
            for number in range(8):
                z, y, x = corner(spot, number)
                row = rows[level][first + t, z, y, x]
                if row >= 0:
                    w = share_of_corner(spot, number, whole)
                    found += load(moving[level], 4 * row, FOUR) * w
        store(spot[0], 0, found)


@kernel
def _add_between(moving, rows, point, time, spot):
    """Add the values of a spot to moving grids at a point and a time."""
    for level in range(len(moving)):
        first, later = _moment(rows[level], time)
        locate(rows[level][0], point, spot)
        added = load(spot[0], 0, FOUR)
        for t in range(2):
            whole = later if t else np.float32(1.0) - later
            for number in range(8):
                z, y, x = corner(spot, number)
                row = rows[level][first + t, z, y, x]
                if row >= 0:
                    w = share_of_corner(spot, number, whole)
                    store(moving[level], 4 * row, load(moving[level], 4 * row, FOUR) + added * w)


@kernel
def _slope_between(moving, rows, point, time, spot):
    """How a loss grows with time at a point, given how it does with what is found there."""
    grows = np.float32(0.0)
    for level in range(len(moving)):
        first, _ = _moment(rows[level], time)
        locate(rows[level][0], point, spot)
        grows += _slope_in(moving[level], rows[level], first, spot)
    return grows


@kernel
def _slope_in(values, rows, first, spot):
    """What one grid adds to that."""
    slope = load(spot[0], 0, FOUR)
    grows = np.float32(0.0)
    for t in range(2):
        for number in range(8):
            z, y, x = corner(spot, number)
            row = rows[first + t, z, y, x]
            if row >= 0:
                change = total(load(values, 4 * row, FOUR) * slope)
                change *= share_of_corner(spot, number, np.float32(1.0))
                grows += change if t else -change
    return grows * np.float32(0.5 * (len(rows) - 1))


@kernel
def _walk(field, rays, ray, trace, spot):
    """Fill the trace of one ray; returns how many samples it has."""
    still, moving, rows = field
    time, place, found = rays[2][ray], rays[3][ray], spot[0]
    clear, kept = 1.0, 0
    for s in range(len(place)):
        point = point_on(rays, ray, place[s])
        if not inside(point):
            if kept:
                break  # the box has no dents
            continue
        found[:] = 0.0
        look(still, point, spot)
        _look_between(moving, rows, point, time, spot)
        clear = note(trace[kept], s, found, clear)
        kept += 1
        if clear < DARK:
            break
    return kept


@kernel
def _forward(worker, workers, field, rays, learning, met, out):
    """Colour, depth and opacity of a share of the rays, and the samples that they met."""
    traces, counts = met
    spot = new_spot()
    for ray in range(*share(worker, workers, len(out))):
        trace = traces[ray if learning else worker]
        counts[ray] = _walk(field, rays, ray, trace, spot)
        gather(trace, counts[ray], rays[3][ray], out[ray])


@kernel
def _backward(worker, workers, field, rays, lists, wanted, parts):
    """Gradients of the grids; part after part, each into its own sum; those of times, if asked."""
    _, moving, rows = field
    time, place = rays[2], rays[3]
    (traces, counts), of_time = lists
    spot = new_spot()
    for part in range(worker, len(parts), workers):
        to_still, to_moving = parts[part]
        for ray in range(*share(part, len(parts), len(wanted))):
            behind = 0.0
            for k in range(counts[ray] - 1, -1, -1):
                row = traces[ray, k]
                z = place[ray, int(row[0])]
                behind = slopes(row, z, wanted[ray], behind, spot[0])
                point = point_on(rays, ray, z)
                add(to_still, point, spot)
                _add_between(to_moving, rows, point, time[ray], spot)
                if len(of_time) and -1.0 <= time[ray] <= 1.0:
                    of_time[ray] += _slope_between(moving, rows, point, time[ray], spot)
