"""Interpolation in voxel grids and its gradient, as kernels; see `ops.voxel_march` for the grids.

The eight *corners* of the cell that a point is in are numbered 0...7, along x first. The *buffers*
of a lookup are: four values that were read or are to be added, the first corner of the cell, and
the fraction of the way to the next along each axis.

Marching kernels record the samples of a ray in a table with a row for each: its number along the
ray, its opacity (alpha), its weight (the share of the ray's light that it contributes), the slope
of softplus, and three colours.
"""

import math

import numpy as np
import torch

from sharpfield.ops.fast._kernel import kernel, share
from sharpfield.ops.fast._lanes import lanes_for, load, store, total
from sharpfield.ops.voxel_march import DENSITY_SHIFT

# pyright: basic


FOUR = lanes_for(4)
"""Raw density and raw colour."""


@kernel
def lookup_buffers():
    """Values, first corner and fractions of one lookup."""
    return np.empty(4, np.float32), np.empty(3, np.int64), np.empty(3, np.float32)


@kernel
def point_on(rays, ray, depth):
    """The point of a ray at a depth."""
    origin, direction = rays[0], rays[1]
    return (
        origin[ray, 0] + depth * direction[ray, 0],
        origin[ray, 1] + depth * direction[ray, 1],
        origin[ray, 2] + depth * direction[ray, 2],
    )


@kernel
def inside(point):
    """Whether a point is in the box."""
    x, y, z = point
    return -1.0 <= x <= 1.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 1.0


@kernel
def _locate(grid, point, buffers):
    """Find the cell of a grid that a point inside the box is in."""
    _, first, fraction = buffers
    for axis in range(3):
        size = grid.shape[2 - axis]
        at = (point[axis] + 1.0) * 0.5 * (size - 1)
        first[axis] = min(int(at), size - 2)
        fraction[axis] = np.float32(at - first[axis])


@kernel
def _corner(buffers, number):
    """Indices of a corner along z, y and x."""
    first = buffers[1]
    return first[2] + (number >> 2), first[1] + (number >> 1 & 1), first[0] + (number & 1)


@kernel
def _corner_weight(buffers, number, whole):
    """Trilinear weight of a corner; those of all eight sum to `whole`."""
    x, y, z = buffers[2]
    whole *= z if number & 4 else np.float32(1.0) - z
    whole *= y if number & 2 else np.float32(1.0) - y
    return whole * (x if number & 1 else np.float32(1.0) - x)


@kernel
def _moment(rows, time):
    """The moment before a time, and the fraction of the way to the next one."""
    at = (min(max(time, -1.0), 1.0) + 1.0) * 0.5 * (len(rows) - 1)
    first = min(int(at), len(rows) - 2)
    return first, np.float32(at - first)


@kernel
def read_static(grids, point, buffers):
    """Add the values of static grids at a point to those of the buffers."""
    for level in range(len(grids)):
        grid = grids[level]
        _locate(grid, point, buffers)
        found = load(buffers[0], 0, FOUR)
        for number in range(8):
            z, y, x = _corner(buffers, number)
            at = 4 * ((z * grid.shape[1] + y) * grid.shape[2] + x)
            found += load(grid, at, FOUR) * _corner_weight(buffers, number, np.float32(1.0))
        store(buffers[0], 0, found)


@kernel
def read_moving(moving, rows, point, time, ray, buffers):
    """Add the values of moving grids, if any, at a point and the time of a ray."""
    if moving is not None:
        for level in range(len(moving)):
            first, later = _moment(rows[level], time[ray])
            _locate(rows[level][0], point, buffers)
            found = load(buffers[0], 0, FOUR)
            for t in range(2):
                whole = later if t else np.float32(1.0) - later
                for number in range(8):
                    z, y, x = _corner(buffers, number)
                    row = rows[level][first + t, z, y, x]
                    if row >= 0:
                        w = _corner_weight(buffers, number, whole)
                        found += load(moving[level], 4 * row, FOUR) * w
            store(buffers[0], 0, found)


@kernel
def zero(grids):
    """Set all grids, if any, to zero."""
    if grids is not None:
        for level in range(len(grids)):
            grids[level][:] = 0.0


@kernel
def add_to_static(grids, point, buffers):
    """Add the values of the buffers to static grids at a point: the adjoint of `read_static`."""
    for level in range(len(grids)):
        grid = grids[level]
        _locate(grid, point, buffers)
        added = load(buffers[0], 0, FOUR)
        for number in range(8):
            z, y, x = _corner(buffers, number)
            at = 4 * ((z * grid.shape[1] + y) * grid.shape[2] + x)
            w = _corner_weight(buffers, number, np.float32(1.0))
            store(grid, at, load(grid, at, FOUR) + added * w)


@kernel
def add_to_moving(moving, rows, point, time, ray, buffers):
    """Add the values of the buffers to moving grids: the adjoint of `read_moving`."""
    if moving is not None:
        for level in range(len(moving)):
            first, later = _moment(rows[level], time[ray])
            _locate(rows[level][0], point, buffers)
            added = load(buffers[0], 0, FOUR)
            for t in range(2):
                whole = later if t else np.float32(1.0) - later
                for number in range(8):
                    z, y, x = _corner(buffers, number)
                    row = rows[level][first + t, z, y, x]
                    if row >= 0:
                        w = _corner_weight(buffers, number, whole)
                        held = load(moving[level], 4 * row, FOUR)
                        store(moving[level], 4 * row, held + added * w)


@kernel
def time_gradient(moving, rows, point, time, ray, buffers):
    """Gradient of the loss by the time of a ray, from that by the values at one of its points."""
    gradient = np.float32(0.0)
    if moving is not None:
        for level in range(len(moving)):
            first, _ = _moment(rows[level], time[ray])
            _locate(rows[level][0], point, buffers)
            gradient += _time_gradient_of(moving[level], rows[level], first, buffers)
    return gradient


@kernel
def _time_gradient_of(values, rows, first, buffers):
    """The part of one grid."""
    slope = load(buffers[0], 0, FOUR)
    gradient = np.float32(0.0)
    for t in range(2):
        for number in range(8):
            z, y, x = _corner(buffers, number)
            row = rows[first + t, z, y, x]
            if row >= 0:
                change = total(load(values, 4 * row, FOUR) * slope)
                change *= _corner_weight(buffers, number, np.float32(1.0))
                gradient += change if t else -change
    return gradient * np.float32(0.5 * (len(rows) - 1))


PARTS = 2
"""Parts of the rays with a gradient sum of their own; a constant, so that sums do not depend on the
number of threads."""

MIN_TRANSMITTANCE = 1e-5
"""A ray ends when less than this share of light gets through."""

MIN_WEIGHT = 1e-7
"""The colour of a sample of smaller weight is not computed."""

COLUMNS = 7
"""Of the table of a ray."""


def sample_buffers(rays: int, samples: int, *, learning: bool) -> tuple[np.ndarray, np.ndarray]:
    """Memory for the samples of rays `[rays, samples, COLUMNS]`, and for how many each has.

    Without gradients one table for each worker is enough; every ray overwrites it.
    """
    count = rays if learning else torch.get_num_threads()
    return np.empty((count, samples, COLUMNS), np.float32), np.empty(rays, np.int64)


@kernel
def record(row, sample, values, transmittance):
    """Record a sample, given the interpolated grid values and the transmittance up to it.

    Returns the transmittance behind it.
    """
    raw = values[0] + DENSITY_SHIFT
    alpha = 1.0 - math.exp(-_softplus(raw))
    row[0], row[1], row[2], row[3] = sample, alpha, transmittance * alpha, _sigmoid(raw)
    _record_colour(row, values)
    return transmittance * (1.0 - alpha)


@kernel
def record_opaque_end(row, sample, values, transmittance):
    """Record a last sample, which absorbs all remaining light."""
    row[0], row[1], row[2], row[3] = sample, 1.0, transmittance, 0.0
    _record_colour(row, values)


@kernel
def _record_colour(row, values):
    if row[2] > MIN_WEIGHT:
        row[4], row[5], row[6] = _sigmoid(values[1]), _sigmoid(values[2]), _sigmoid(values[3])
    else:
        row[4] = row[5] = row[6] = 0.0


@kernel
def _softplus(raw):
    return raw if raw > 15.0 else math.log1p(math.exp(raw))


@kernel
def _sigmoid(raw):
    return 1.0 / (1.0 + math.exp(-raw))


@kernel
def composite(samples, count, depths, out):
    """Colour, depth and opacity of a ray; `depths` are those of all its samples."""
    red = green = blue = depth = opacity = 0.0
    for k in range(count):
        w = samples[k, 2]
        red += w * samples[k, 4]
        green += w * samples[k, 5]
        blue += w * samples[k, 6]
        depth += w * depths[int(samples[k, 0])]
        opacity += w
    out[0], out[1], out[2], out[3], out[4] = red, green, blue, depth, opacity


@kernel
def sample_gradient(row, depth, grad_out, behind, grad_values):
    """Gradient by the grid values at a sample, written to `grad_values`.

    `behind` is the sum over later samples of weight times contribution to the loss; returns that
    sum with this sample.
    """
    value = grad_out[0] * row[4] + grad_out[1] * row[5] + grad_out[2] * row[6]
    value += grad_out[3] * depth + grad_out[4]
    # d w_k / d tau = T_k e^-tau; every later weight falls in proportion.
    front = row[2] / row[1] if row[1] > 0.0 else 0.0
    grad_values[0] = row[3] * (front * (1.0 - row[1]) * value - behind)
    for c in range(3):
        grad_values[1 + c] = row[2] * grad_out[c] * row[4 + c] * (1.0 - row[4 + c])
    return behind + row[2] * value


@kernel
def add_parts(worker, workers, sums):
    """Add all parts `[p, n]` to the first."""
    first, last = share(worker, workers, sums.shape[1])
    for part in range(1, len(sums)):
        for i in range(first, last):
            sums[0, i] += sums[part, i]
