"""Gaussians drawn in tiles the straightforward way: the opponent of `ops/fast/rasterizer.py`.

Splats come from the definition's projection. Each is listed, in order of depth, in all tiles that a
square around it touches; every pixel walks through the list of its tile on its own, forwards until
next to no light is left, and backwards from there. Every thread adds up gradients of its own.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.fast._kernel import kernel, memory, spread
from sharpfield.ops.rasterizer import FAINTEST, MOST, Canvas, Drawn, project

TILE = 16
REACH = 3.33
"""Standard deviations after which no splat stops more light than the faintest that is drawn."""

DARK = np.float32(1e-4)
"""A pixel is finished when less light than this gets through."""

FAINT, FULL = np.float32(FAINTEST), np.float32(MOST)
ONE, HALF = np.float32(1), np.float32(0.5)


def rasterize(*gaussians: Any) -> Drawn:
    """As `ops.rasterizer`, without shifts."""
    means, quaternions, scales, opacities, colours, poses, canvas = gaussians
    splats = project(means, quaternions, scales, opacities, poses, canvas)
    features = torch.cat([colours, splats.depth[..., None]], -1)
    images = _Blend.apply(canvas, splats.centre, splats.conic, splats.opacity, features)
    return Drawn(images[..., :-2], images[..., -2], 1 - images[..., -1])


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, canvas: Canvas, *splats: Tensor) -> Tensor:
        splats = tuple(value.contiguous() for value in splats)
        arrays = tuple(memory(value) for value in splats)
        views, _, channels = arrays[3].shape
        width, height = canvas.size
        images = np.empty((views, height, width, channels + 1), np.float32)
        last = np.empty((views, height, width), np.int64)
        lists = [_listed(*(array[v] for array in arrays), canvas) for v in range(views)]
        for v in range(views):
            seen = tuple(array[v] for array in arrays)
            spread(_forwards, *lists[v], seen, images[v], last[v])
        ctx.save_for_backward(*splats)
        ctx.kept = lists, images, last
        return torch.from_numpy(images)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, wanted: Tensor) -> tuple[Tensor | None, ...]:
        arrays = tuple(memory(value) for value in ctx.saved_tensors)
        lists, images, last = ctx.kept
        views, count, channels = arrays[3].shape
        asked, workers = memory(wanted.contiguous()), torch.get_num_threads()
        found = torch.empty(views, count, 6 + channels)
        for v in range(views):
            seen = tuple(array[v] for array in arrays)
            sums = np.zeros((workers, count, 6 + channels), np.float32)
            spread(_backwards, *lists[v], seen, images[v], last[v], asked[v], sums)
            found[v] = torch.from_numpy(sums.sum(0))
        return None, found[..., :2], found[..., 2:5], found[..., 5], found[..., 6:]


def _listed(
    centre: np.ndarray, conic: np.ndarray, opacity: np.ndarray, features: np.ndarray, canvas: Canvas
) -> tuple[np.ndarray, np.ndarray]:
    """Where the list of each tile begins, and all lists after each other."""
    across, down = (-(-side // TILE) for side in canvas.size)
    order = np.argsort(features[:, -1], kind="stable")
    starts = np.zeros(across * down + 1, np.int64)
    _list(centre, conic, opacity, order, across, starts, np.empty(0, np.int64))
    starts = np.cumsum(starts)
    lists = np.empty(starts[-1], np.int64)
    _list(centre, conic, opacity, order, across, starts[:-1].copy(), lists)
    return starts, lists


@kernel
def _list(centre, conic, opacity, order, across, places, lists):
    """Count what each tile lists, or with room for it, list it."""
    counting = len(lists) == 0
    down = len(places) // across
    for g in order:
        if opacity[g] <= 0:
            continue
        a, b, c = conic[g, 0], conic[g, 1], conic[g, 2]
        radius = REACH * np.sqrt(max(a, c) / (a * c - b * b))
        left, right = (centre[g, 0] - radius) // TILE, (centre[g, 0] + radius) // TILE
        top, bottom = (centre[g, 1] - radius) // TILE, (centre[g, 1] + radius) // TILE
        for y in range(max(int(top), 0), min(int(bottom) + 1, down)):
            for x in range(max(int(left), 0), min(int(right) + 1, across)):
                tile = y * across + x
                if counting:
                    places[tile + 1] += 1
                else:
                    lists[places[tile]] = g
                    places[tile] += 1


@kernel
def _alpha(splats, g, x, y):
    """How much of the light a splat stops at a pixel, and before it is limited; and the offset."""
    centre, conic, opacity, _ = splats
    dx, dy = np.float32(x) + HALF - centre[g, 0], np.float32(y) + HALF - centre[g, 1]
    a, b, c = conic[g, 0], conic[g, 1], conic[g, 2]
    power = -HALF * (a * dx * dx + c * dy * dy) - b * dx * dy
    full = opacity[g] * np.exp(power)
    return min(full, FULL), full, dx, dy


@kernel
def _forwards(worker, workers, starts, lists, splats, image, last):
    height, width = last.shape
    across = (width + TILE - 1) // TILE
    features = splats[3]
    for tile in range(worker, len(starts) - 1, workers):
        for y in range(tile // across * TILE, min(tile // across * TILE + TILE, height)):
            for x in range(tile % across * TILE, min(tile % across * TILE + TILE, width)):
                pixel = image[y, x]
                pixel[:] = 0
                left = ONE
                at = starts[tile]
                while at < starts[tile + 1] and left > DARK:
                    g = lists[at]
                    alpha, _, _, _ = _alpha(splats, g, x, y)
                    if alpha >= FAINT:
                        for k in range(features.shape[1]):
                            pixel[k] += left * alpha * features[g, k]
                        left *= ONE - alpha
                    at += 1
                pixel[-1] = left
                last[y, x] = at


@kernel
def _backwards(worker, workers, starts, lists, splats, image, last, wanted, sums):
    height, width = last.shape
    across = (width + TILE - 1) // TILE
    _, conic, opacity, features = splats
    for tile in range(worker, len(starts) - 1, workers):
        for y in range(tile // across * TILE, min(tile // across * TILE + TILE, height)):
            for x in range(tile % across * TILE, min(tile % across * TILE + TILE, width)):
                asked = wanted[y, x]
                left = image[y, x, -1]
                behind = asked[-1] * left
                for at in range(last[y, x] - 1, starts[tile] - 1, -1):
                    g = lists[at]
                    alpha, full, dx, dy = _alpha(splats, g, x, y)
                    if alpha < FAINT:
                        continue
                    left /= ONE - alpha
                    value = np.float32(0)
                    out = sums[worker, g]
                    for k in range(features.shape[1]):
                        value += asked[k] * features[g, k]
                        out[6 + k] += asked[k] * left * alpha
                    slope = left * value - behind / (ONE - alpha)
                    behind += left * alpha * value
                    if full > FULL:
                        continue
                    out[5] += slope * alpha / opacity[g]
                    slope *= alpha
                    out[0] += slope * (conic[g, 0] * dx + conic[g, 1] * dy)
                    out[1] += slope * (conic[g, 2] * dy + conic[g, 1] * dx)
                    out[2] -= HALF * slope * dx * dx
                    out[3] -= slope * dx * dy
                    out[4] -= HALF * slope * dy * dy
