# pyright: basic
"""Marching through voxel grids on the CPU: one pass forwards, and one back along what it met.

Rays are cut into PARTS shares with a gradient grid each, which are added at the end, so that sums
do not depend on the number of threads. A ray ends once next to nothing gets through.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.fast._voxels import add, locate, look, merge, sigmoid, softplus
from sharpfield.ops.voxel_march import THIN, march

PARTS = 2
"""Shares of the rays with a gradient of their own: a constant, see above."""

DARK = 1e-5
"""A ray ends when less than this share of light gets through."""

COLUMNS = 7
"""Of the trace of a ray, see `_walk`."""

FAINT = 1e-7
"""The colour of a sample with a smaller share of the ray's light is not computed."""


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
        # Without gradients one trace for each worker is enough, written over by every ray.
        learning = any(ctx.needs_input_grad)
        traces = len(origin) if learning else torch.get_num_threads()
        trace = np.empty((traces, place.shape[1], COLUMNS), np.float32)
        kept = np.empty(len(origin), np.int64)
        spread(_forward, cells, rays, (opaque_end, learning), (trace, kept), memory(out))
        ctx.met = (trace, kept) if learning else None
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        origin, direction, place, *grids = ctx.saved_tensors
        # Numpy asks for huge pages, which are several times faster to fill.
        sums = tuple(np.empty((PARTS, *grid.shape), np.float32) for grid in grids)
        rays = (memory(origin), memory(direction), memory(place))
        wanted = memory(gradients[0].contiguous())
        cells = tuple(memory(grid) for grid in grids)
        spread(_backward, cells, rays, ctx.met, wanted, sums)
        spread(merge, sums)
        return None, None, None, None, *[torch.from_numpy(total[0]) for total in sums]


@kernel
def _find(grids, rays, ray, z, scratch):
    """Locate a point of a ray in every grid; False outside."""
    origin, direction = rays[0][ray], rays[1][ray]
    corner, weight = scratch[1], scratch[2]
    x, y = origin[0] + z * direction[0], origin[1] + z * direction[1]
    w = origin[2] + z * direction[2]
    inside = True
    for level in range(len(grids)):
        inside = locate(grids[level], x, y, w, corner[level], weight[level])
    return inside


@kernel
def _walk(grids, rays, ray, opaque_end, trace, scratch):
    """Fill the trace of one ray; returns how many samples it has.

    Columns of the trace: number of the sample, opacity, weight, softplus' slope, three colours.
    """
    place = rays[2][ray]
    found, corner, weight = scratch
    samples = len(place)
    clear = 1.0
    kept = 0
    for s in range(samples):
        last = opaque_end and s == samples - 1
        inside = _find(grids, rays, ray, place[s], scratch)
        if not (inside or last):
            continue
        found[:] = 0.0
        if inside:
            for level in range(len(grids)):
                look(grids[level], corner[level], weight[level], found)
        raw = found[0] + THIN
        alpha = 1.0 if last else 1.0 - math.exp(-softplus(raw))
        row = trace[kept]
        row[0] = s
        row[1] = alpha
        row[2] = clear * alpha
        row[3] = 0.0 if last else sigmoid(raw)
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
def _scratch(levels):
    """Room for what was found at a point, and for the point located in each grid."""
    return (
        np.empty(4, np.float32),
        np.empty((levels, 3), np.int64),
        np.empty((levels, 3), np.float32),
    )


@kernel
def _forward(worker, workers, grids, rays, mode, met, out):
    """Colour, depth and opacity of a share of the rays, and the samples that they met."""
    place = rays[2]
    opaque_end, learning = mode
    traces, counts = met
    scratch = _scratch(len(grids))
    for ray in range(*share(worker, workers, len(out))):
        trace = traces[ray if learning else worker]
        kept = _walk(grids, rays, ray, opaque_end, trace, scratch)
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
def _backward(worker, workers, grids, rays, met, wanted, sums):
    """Gradients of the grids; part after part, each into its own sum."""
    place = rays[2]
    traces, counts = met
    scratch = _scratch(len(grids))
    corner, weight = scratch[1], scratch[2]
    for part in range(worker, PARTS, workers):
        for level in range(len(grids)):
            sums[level][part] = 0.0
        for ray in range(*share(part, PARTS, len(wanted))):
            trace, kept = traces[ray], counts[ray]
            g = wanted[ray]
            behind = 0.0  # sum over later samples of weight times what it adds to the loss
            for k in range(kept - 1, -1, -1):
                row = trace[k]
                s = int(row[0])
                z = place[ray, s]
                value = g[0] * row[4] + g[1] * row[5] + g[2] * row[6] + g[3] * z + g[4]
                through = 1.0 - row[1]
                slope = 0.0
                if row[3] > 0.0:
                    # d w_k / d tau = T_k e^-tau; every later weight falls in proportion.
                    front = row[2] / row[1] if row[1] > 0.0 else 0.0
                    slope = row[3] * (front * through * value - behind)
                behind += row[2] * value
                if not _find(grids, rays, ray, z, scratch):
                    continue
                for level in range(len(grids)):
                    add(
                        sums[level][part],
                        corner[level],
                        weight[level],
                        np.float32(slope),
                        np.float32(row[2] * g[0] * row[4] * (1.0 - row[4])),
                        np.float32(row[2] * g[1] * row[5] * (1.0 - row[5])),
                        np.float32(row[2] * g[2] * row[6] * (1.0 - row[6])),
                    )
