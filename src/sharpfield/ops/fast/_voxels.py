# pyright: basic
"""Interpolation in voxel grids and its gradient, as kernels; see `ops.voxel_march` for the grids.

The eight *corners* of the cell that a point is in are numbered 0...7, along x first. The *buffers*
of a lookup are: four values that were read or are to be added, the first corner of the cell, and
the fraction of the way to the next along each axis.
"""

import numpy as np

from sharpfield.ops.fast._kernel import kernel
from sharpfield.ops.fast._lanes import lanes_for, load, store, total

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
