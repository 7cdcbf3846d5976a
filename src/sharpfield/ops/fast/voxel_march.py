# pyright: basic
"""Marching through voxel grids on the CPU: one pass forwards, and one back along what it met.

Rays are cut into PARTS shares with a gradient grid each, which are added at the end. A ray ends
once next to nothing gets through.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.fast._trace import (
    DARK,
    PARTS,
    gather,
    merge,
    note,
    note_end,
    room_for_traces,
    slopes,
)
from sharpfield.ops.fast._voxels import add, inside, look, new_spot, point_on
from sharpfield.ops.voxel_march import march


@march.accelerate("cpu", needs="numba")
def _(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    place: Float[Tensor, "b s"],
    grids: Sequence[Float[Tensor, "_ _ _ 4"]],
    *,
    opaque_end: bool = True,
) -> Float[Tensor, "b 5"]:
    moving = any(x.requires_grad for x in (origin, direction, place))
    if moving or any(grid.dtype != torch.float32 for grid in grids):
        return march.reference(origin, direction, place, grids, opaque_end=opaque_end)
    rays = [x.contiguous() for x in (origin, direction, place)]
    return _March.apply(*rays, opaque_end, *[grid.contiguous() for grid in grids])


class _March(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        origin: Tensor,
        direction: Tensor,
        place: Tensor,
        opaque_end: bool,
        *grids: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(origin, direction, place, *grids)
        out = torch.empty(len(origin), 5)
        rays = (memory(origin), memory(direction), memory(place))
        cells = tuple(memory(grid) for grid in grids)
        learning = any(ctx.needs_input_grad)
        met = room_for_traces(*place.shape, learning=learning)
        spread(_forward, cells, rays, (opaque_end, learning), met, memory(out))
        ctx.met = met if learning else None
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        origin, direction, place, *grids = ctx.saved_tensors
        # Numpy asks for huge pages, which are several times faster to fill.
        sums = [np.empty((PARTS, *grid.shape), np.float32) for grid in grids]
        parts = tuple(tuple(total[k] for total in sums) for k in range(PARTS))
        rays = (memory(origin), memory(direction), memory(place))
        wanted = memory(gradients[0].contiguous())
        spread(_backward, rays, ctx.met, wanted, parts)
        for total in sums:
            spread(merge, total.reshape(PARTS, -1))
        return None, None, None, None, *[torch.from_numpy(total[0]) for total in sums]


@kernel
def _walk(grids, rays, ray, opaque_end, trace, spot):
    """Fill the trace of one ray; returns how many samples it has."""
    place, found = rays[2][ray], spot[0]
    clear, kept = 1.0, 0
    for s in range(len(place)):
        point = point_on(rays, ray, place[s])
        last = opaque_end and s == len(place) - 1
        within = inside(point)
        if not (within or last):
            continue
        found[:] = 0.0
        if within:
            look(grids, point, spot)
        if last:
            note_end(trace[kept], s, found, clear)
        else:
            clear = note(trace[kept], s, found, clear)
        kept += 1
        if clear < DARK:
            break
    return kept


@kernel
def _forward(worker, workers, grids, rays, mode, met, out):
    """Colour, depth and opacity of a share of the rays, and the samples that they met."""
    opaque_end, learning = mode
    traces, counts = met
    spot = new_spot()
    for ray in range(*share(worker, workers, len(out))):
        trace = traces[ray if learning else worker]
        counts[ray] = _walk(grids, rays, ray, opaque_end, trace, spot)
        gather(trace, counts[ray], rays[2][ray], out[ray])


@kernel
def _backward(worker, workers, rays, met, wanted, parts):
    """Gradients of the grids; part after part, each into its own sum."""
    place = rays[2]
    traces, counts = met
    spot = new_spot()
    for part in range(worker, PARTS, workers):
        for level in range(len(parts[part])):
            parts[part][level][:] = 0.0
        for ray in range(*share(part, PARTS, len(wanted))):
            behind = 0.0
            for k in range(counts[ray] - 1, -1, -1):
                row = traces[ray, k]
                z = place[ray, int(row[0])]
                behind = slopes(row, z, wanted[ray], behind, spot[0])
                point = point_on(rays, ray, z)
                if inside(point):  # the end may lie behind the box
                    add(parts[part], point, spot)
