# pyright: basic
"""Volume rendering of voxel grids on the CPU: one pass forwards, one back over the same samples.

The rays are split into PARTS, each with a gradient grid of its own; these are added at the end. A
ray ends once its transmittance is below MIN_TRANSMITTANCE.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.fast._voxels import (
    MIN_TRANSMITTANCE,
    PARTS,
    add_parts,
    add_to_moving,
    add_to_static,
    composite,
    inside,
    lookup_buffers,
    point_on,
    read_moving,
    read_static,
    record,
    record_opaque_end,
    sample_buffers,
    sample_gradient,
    time_gradient,
    zero,
)
from sharpfield.ops.voxel_march import march_voxels


@march_voxels.accelerate("cpu", needs="numba")
def _(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    depths: Float[Tensor, "b s"],
    static: Sequence[Float[Tensor, "_ _ _ 4"]],
    moving: Sequence[Float[Tensor, "_ 4"]] = (),
    rows: Sequence[Int32[Tensor, "_ _ _ _"]] = (),
    time: Float[Tensor, "b"] | None = None,
    *,
    opaque_end: bool = True,
) -> Float[Tensor, "b 5"]:
    grids = (*static, *moving)
    if (
        any(x.requires_grad for x in (origin, direction, depths))
        or any(grid.dtype != torch.float32 for grid in grids)
        or (moving and time is None)
    ):
        given = (origin, direction, depths, static, moving, rows, time)
        return march_voxels.reference(*given, opaque_end=opaque_end)
    if time is None:
        time = origin.new_zeros(0)  # no kernel reads it
    rays = [x.contiguous() for x in (origin, direction, depths, time)]
    cells = tuple(memory(x.contiguous()) for x in rows)
    return _March.apply(*rays, cells, opaque_end, *[grid.contiguous() for grid in grids])


class _March(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        origin: Tensor,
        direction: Tensor,
        depths: Tensor,
        time: Tensor,
        rows: tuple[np.ndarray, ...],
        opaque_end: bool,
        *grids: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(origin, direction, depths, time, *grids)
        ctx.rows = rows
        out = torch.empty(len(origin), 5)
        rays = tuple(memory(x) for x in (origin, direction, depths, time))
        learning = any(ctx.needs_input_grad)
        samples = sample_buffers(*depths.shape, learning=learning)
        field = (*_split([memory(grid) for grid in grids], len(rows)), rows or None)
        spread(_forward, field, rays, (opaque_end, learning), samples, memory(out))
        ctx.samples = samples if learning else None
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rays, grids, rows = ctx.saved_tensors[:4], ctx.saved_tensors[4:], ctx.rows
        # Numpy asks for huge pages, which are several times faster to fill.
        sums = [np.empty((PARTS, *grid.shape), np.float32) for grid in grids]
        parts = tuple(_split([total[k] for total in sums], len(rows)) for k in range(PARTS))
        grad_out = memory(gradients[0].contiguous())
        # Of no ray where nobody asks for the gradient of time.
        grad_time = torch.zeros(len(rays[3]) if ctx.needs_input_grad[3] else 0)
        field = (*_split([memory(grid) for grid in grids], len(rows)), rows or None)
        given = tuple(memory(x) for x in rays)
        spread(_backward, field, given, (ctx.samples, memory(grad_time)), grad_out, parts)
        for total in sums:
            spread(add_parts, total.reshape(PARTS, -1))
        found = grad_time if ctx.needs_input_grad[3] else None
        return None, None, None, found, None, None, *[torch.from_numpy(t[0]) for t in sums]


def _split(grids: Sequence[np.ndarray], moving: int) -> tuple[Any, Any]:
    """Static grids, and the values of moving ones: None without any, so that no code reads them."""
    static = len(grids) - moving
    return tuple(grids[:static]), tuple(grids[static:]) or None


@kernel
def _sample(field, rays, ray, opaque_end, samples, buffers):
    """Record the samples of one ray; returns how many there are."""
    static, moving, rows = field
    depths, values = rays[2][ray], buffers[0]
    transmittance, count = 1.0, 0
    for s in range(len(depths)):
        point = point_on(rays, ray, depths[s])
        last = opaque_end and s == len(depths) - 1
        within = inside(point)
        if not (within or last):
            if count and not opaque_end:
                break  # the box is convex: the ray has left it
            continue
        values[:] = 0.0
        if within:
            read_static(static, point, buffers)
            read_moving(moving, rows, point, rays[3], ray, buffers)
        if last:
            record_opaque_end(samples[count], s, values, transmittance)
        else:
            transmittance = record(samples[count], s, values, transmittance)
        count += 1
        if transmittance < MIN_TRANSMITTANCE:
            break
    return count


@kernel
def _forward(worker, workers, field, rays, mode, recorded, out):
    """Colour, depth and opacity of a share of the rays, and the samples on them."""
    opaque_end, learning = mode
    samples, counts = recorded
    buffers = lookup_buffers()
    for ray in range(*share(worker, workers, len(out))):
        own = samples[ray if learning else worker]
        counts[ray] = _sample(field, rays, ray, opaque_end, own, buffers)
        composite(own, counts[ray], rays[2][ray], out[ray])


@kernel
def _backward(worker, workers, field, rays, lists, grad_out, parts):
    """Gradients of the grids; part after part, each into its own sum; those of times, if asked."""
    _, moving, rows = field
    depths, time = rays[2], rays[3]
    (samples, counts), grad_time = lists
    buffers = lookup_buffers()
    for part in range(worker, len(parts), workers):
        grad_static, grad_moving = parts[part]
        zero(grad_static)
        zero(grad_moving)
        for ray in range(*share(part, len(parts), len(grad_out))):
            behind = 0.0
            for k in range(counts[ray] - 1, -1, -1):
                sample = samples[ray, k]
                depth = depths[ray, int(sample[0])]
                behind = sample_gradient(sample, depth, grad_out[ray], behind, buffers[0])
                point = point_on(rays, ray, depth)
                if inside(point):  # an opaque end may lie behind the box
                    add_to_static(grad_static, point, buffers)
                    add_to_moving(grad_moving, rows, point, time, ray, buffers)
                    if len(grad_time) and -1.0 <= time[ray] <= 1.0:
                        grad_time[ray] += time_gradient(moving, rows, point, time, ray, buffers)
