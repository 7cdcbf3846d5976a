# pyright: basic
"""Reading levels on the CPU: all of them for one pixel after the other.

Gradients of a level are added by one worker, pixel after pixel, so sums do not depend on the number
of threads.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import empty, kernel, memory, share, spread
from sharpfield.ops.pyramid import sample_pyramid


@sample_pyramid.accelerate("cpu", needs="numba")
def _(
    xy: Float[Tensor, "m 2"],
    source: Int64[Tensor, "m"],
    levels: Sequence[Float[Tensor, "_n _h _w _f"]],
) -> Float[Tensor, "m f"]:
    return _LookUp.apply(xy.contiguous(), source, *[level.contiguous() for level in levels])


class _LookUp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, xy: Tensor, source: Tensor, *levels: Tensor) -> Tensor:
        ctx.save_for_backward(xy, source, *levels)
        out = empty(xy, len(xy), sum(level.shape[-1] for level in levels))
        maps = tuple(memory(level) for level in levels)
        spread(_gather, memory(xy), memory(source.contiguous()), maps, memory(out))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        xy, source, *levels = ctx.saved_tensors
        grad = memory(gradients[0].contiguous())
        maps = tuple(memory(level) for level in levels)
        at = memory(xy), memory(source.contiguous())
        of_xy = None
        if ctx.needs_input_grad[0]:
            of_xy = torch.zeros_like(xy)
            spread(_slope, *at, maps, grad, memory(of_xy))
        of_levels: list[Tensor | None] = [None] * len(levels)
        # A image is no parameter: its level is left out, and so are its channels.
        wanted = np.array(ctx.needs_input_grad[2:])
        if wanted.any():
            sums = tuple(np.zeros_like(one) for one in maps)
            spread(_scatter, *at, wanted, grad, sums)
            of_levels = [
                torch.from_numpy(one) if asked else None
                for one, asked in zip(sums, wanted, strict=True)
            ]
        return of_xy, None, *of_levels


@kernel
def _locate(place, size, whole):
    """Cell and its successor along one axis, the share of the latter, and the slope of that."""
    ratio = size / whole
    at = place * ratio - 0.5
    if at < 0.0:
        at, ratio = 0.0, 0.0
    elif at > size - 1.0:
        at, ratio = size - 1.0, 0.0
    low = int(at)
    return low, min(low + 1, size - 1), at - low, ratio


@kernel
def _gather(worker, workers, xy, source, levels, out):
    """Features of a share of the pixels."""
    height, width = levels[0].shape[1], levels[0].shape[2]
    for m in range(*share(worker, workers, len(xy))):
        first = 0
        for index in range(len(levels)):
            level = levels[index][source[m]]
            left, right, x, _ = _locate(xy[m, 0], level.shape[1], width)
            top, below, y, _ = _locate(xy[m, 1], level.shape[0], height)
            a, b = (1 - x) * (1 - y), x * (1 - y)
            c, d = (1 - x) * y, x * y
            for f in range(level.shape[2]):
                out[m, first + f] = (
                    a * level[top, left, f]
                    + b * level[top, right, f]
                    + c * level[below, left, f]
                    + d * level[below, right, f]
                )
            first += level.shape[2]


@kernel
def _scatter(worker, workers, xy, source, wanted, grad, sums):
    """Gradients of some of the levels."""
    height, width = sums[0].shape[1], sums[0].shape[2]
    first = 0
    for index in range(len(sums)):
        features = sums[index].shape[3]
        if wanted[index] and index % workers == worker:
            for m in range(len(xy)):
                level = sums[index][source[m]]
                left, right, x, _ = _locate(xy[m, 0], level.shape[1], width)
                top, below, y, _ = _locate(xy[m, 1], level.shape[0], height)
                a, b = (1 - x) * (1 - y), x * (1 - y)
                c, d = (1 - x) * y, x * y
                for f in range(features):
                    g = grad[m, first + f]
                    level[top, left, f] += a * g
                    level[top, right, f] += b * g
                    level[below, left, f] += c * g
                    level[below, right, f] += d * g
        first += features


@kernel
def _slope(worker, workers, xy, source, levels, grad, out):
    """Gradients of a share of the pixels' places."""
    height, width = levels[0].shape[1], levels[0].shape[2]
    for m in range(*share(worker, workers, len(xy))):
        first = 0
        for index in range(len(levels)):
            level = levels[index][source[m]]
            left, right, x, along = _locate(xy[m, 0], level.shape[1], width)
            top, below, y, down = _locate(xy[m, 1], level.shape[0], height)
            for f in range(level.shape[2]):
                g = grad[m, first + f]
                upper = level[top, right, f] - level[top, left, f]
                lower = level[below, right, f] - level[below, left, f]
                out[m, 0] += g * along * ((1 - y) * upper + y * lower)
                fore = level[below, left, f] - level[top, left, f]
                back = level[below, right, f] - level[top, right, f]
                out[m, 1] += g * down * ((1 - x) * fore + x * back)
            first += level.shape[2]
