# pyright: basic
"""Blending of splats in tiles, and its gradient. A row of a tile is one vector register.

A *splat* is a row of numbers: centre x, y, conic xx, xy, yy, opacity, half its height in pixels,
then its *features*: the colour's channels and depth. A *touch* is a splat that overlaps a tile: the
splat's number, and the index where its gradient is written. A *plan* holds the offsets of each
worker's tiles and of each tile's touches, and the touches.
"""

import numpy as np

from sharpfield.ops.fast._kernel import kernel
from sharpfield.ops.fast._lanes import (
    at_most,
    count_up,
    exponential,
    fill,
    load,
    store,
    total,
    where_below,
    where_least,
    zeros,
)
from sharpfield.ops.rasterizer import FAINTEST, MOST

TILE = 16
"""Rows and columns of a tile."""

LANES = (0,) * TILE

GEOMETRY = 7
"""Numbers of a splat before its features."""

DARK = 1e-5
"""A tile is finished when its transmittance is below this at every pixel."""

CHECK_EVERY = 16
"""Touches between two checks whether a tile is finished."""

FAINT, FULL = np.float32(FAINTEST), np.float32(MOST)
ONE, HALF = np.float32(1), np.float32(0.5)


@kernel
def _rows(splat, top, height):
    """Which rows of a tile a splat reaches."""
    first = int(np.ceil(splat[1] - splat[6] - HALF)) - top
    last = int(np.floor(splat[1] + splat[6] - HALF)) - top
    return max(first, 0), min(last + 1, height)


@kernel
def _finished(left, height):
    """Whether the transmittance of a tile is negligible everywhere."""
    for i in range(height * TILE):
        if left[i] > DARK:
            return False
    return True


@kernel
def _place(item, images):
    """View, upper left pixel and size of a tile inside the image."""
    height, width = images.shape[1], images.shape[2]
    across = (width + TILE - 1) // TILE
    down = (height + TILE - 1) // TILE
    view = item // (across * down)
    top = item // across % down * TILE
    corner = item % across * TILE
    return view, top, corner, min(TILE, height - top), min(TILE, width - corner)


@kernel
def blend(worker, workers, plan, splats, images, lanes, features):
    """Fill `images [v h w f+1]` with the weighted sums of the features, and the transmittance."""
    shares, starts, touches = plan
    left = np.empty(TILE * TILE, np.float32)
    sums = np.empty(len(features) * TILE * TILE, np.float32)
    for item in range(shares[worker], shares[worker + 1]):
        view, top, corner, height, width = _place(item, images)
        left[:] = ONE
        sums[:] = 0.0
        for touch in range(starts[item], starts[item + 1]):
            if (touch - starts[item]) % CHECK_EVERY == CHECK_EVERY - 1 and _finished(left, height):
                break
            splat = splats[touches[touch, 0]]
            dx = count_up(np.float32(corner) + HALF - splat[0], lanes)
            across = dx * dx * (-HALF * splat[2])
            slant = dx * -splat[3]
            first, last = _rows(splat, top, height)
            for row in range(first, last):
                dy = np.float32(top + row) + HALF - splat[1]
                power = across + slant * dy + fill(-HALF * splat[4] * dy * dy, lanes)
                alpha = at_most(exponential(power) * splat[5], FULL)
                alpha = where_least(alpha, alpha, FAINT)
                before = load(left, row * TILE, lanes)
                weight = alpha * before
                store(left, row * TILE, before - weight)
                for k in range(len(features)):
                    at = (k * TILE + row) * TILE
                    store(sums, at, load(sums, at, lanes) + weight * splat[GEOMETRY + k])
        for row in range(height):
            for column in range(width):
                pixel = images[view, top + row, corner + column]
                for k in range(len(features)):
                    pixel[k] = sums[(k * TILE + row) * TILE + column]
                pixel[len(features)] = left[row * TILE + column]


@kernel
def _wanted_of_tile(item, images, wanted, gradient, behind, features):
    """The gradient of every feature at every pixel, and `behind` for the first splat.

    *Behind* is the gradient of the loss by the transmittance at a splat: the gradient times the sum
    of all features behind it, minus that of the opacity times the final transmittance.
    """
    view, top, corner, height, width = _place(item, images)
    gradient[:] = 0.0
    behind[:] = 0.0
    last = len(features)
    for row in range(height):
        for column in range(width):
            at = row * TILE + column
            pixel = images[view, top + row, corner + column]
            asked = wanted[view, top + row, corner + column]
            sum_behind = -asked[last] * pixel[last]
            for k in range(len(features)):
                gradient[k * TILE * TILE + at] = asked[k]
                sum_behind += asked[k] * pixel[k]
            behind[at] = sum_behind


@kernel
def blend_back(worker, workers, plan, splats, views, touch_sums, lanes, features):
    """Write the gradient of each touch: centre, conic, opacity, features.

    The views are those that `blend` filled, and their gradient.
    """
    shares, starts, touches = plan
    images, wanted = views
    size = TILE * TILE
    left = np.empty(size, np.float32)
    behind = np.empty(size, np.float32)
    gradient = np.empty(len(features) * size, np.float32)
    asked = np.empty(len(features) * TILE, np.float32)
    for item in range(shares[worker], shares[worker + 1]):
        _, top, corner, height, _ = _place(item, images)
        _wanted_of_tile(item, images, wanted, gradient, behind, features)
        left[:] = ONE
        finished = False
        for touch in range(starts[item], starts[item + 1]):
            out = touch_sums[touches[touch, 1]]
            if not finished and (touch - starts[item]) % CHECK_EVERY == CHECK_EVERY - 1:
                finished = _finished(left, height)
            if finished:
                out[:] = 0.0
                continue
            splat = splats[touches[touch, 0]]
            dx = count_up(np.float32(corner) + HALF - splat[0], lanes)
            across = dx * dx * (-HALF * splat[2])
            slant = dx * -splat[3]
            asked[:] = 0.0
            flat = up = bent = zeros(left, lanes)  # sums of 1, dy and dy^2 times the slope
            first, last = _rows(splat, top, height)
            for row in range(first, last):
                dy = np.float32(top + row) + HALF - splat[1]
                power = across + slant * dy + fill(-HALF * splat[4] * dy * dy, lanes)
                full = exponential(power) * splat[5]
                alpha = at_most(full, FULL)
                alpha = where_least(alpha, alpha, FAINT)
                before = load(left, row * TILE, lanes)
                weight = alpha * before
                store(left, row * TILE, before - weight)
                value = zeros(left, lanes)
                for k in range(len(features)):
                    wants = load(gradient, (k * TILE + row) * TILE, lanes)
                    value += wants * splat[GEOMETRY + k]
                    store(asked, k * TILE, load(asked, k * TILE, lanes) + weight * wants)
                rest = load(behind, row * TILE, lanes) - weight * value
                store(behind, row * TILE, rest)
                slope = before * value - rest / (fill(ONE, lanes) - alpha)
                slope = where_below(slope * alpha, full, FULL)  # of the power
                flat += slope
                up += slope * dy
                bent += slope * (dy * dy)
            _write(out, splat, dx, (flat, up, bent), asked, lanes, features)


@kernel
def _write(out, splat, dx, slopes, asked, lanes, features):
    """The gradient of a touch, from the sums over its rows."""
    flat, up, bent = slopes
    sum_x, sum_y = total(flat * dx), total(up)
    out[0] = splat[2] * sum_x + splat[3] * sum_y
    out[1] = splat[3] * sum_x + splat[4] * sum_y
    out[2] = -HALF * total(flat * dx * dx)
    out[3] = -total(up * dx)
    out[4] = -HALF * total(bent)
    out[5] = total(flat) / splat[5]
    for k in range(len(features)):
        out[6 + k] = total(load(asked, k * TILE, lanes))
