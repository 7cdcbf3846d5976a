# pyright: basic
"""What kernels do at the cells of voxel grids `[d, h, w, 4]`: find them, read them, add to them.

Points are in box coordinates, see `ops.voxel_march`. The eight *corners* of the cell that a point
is in are numbered 0...7, along x first. A *spot* is a point located in a grid: four values that
were read or are to be added there, the first corner, and how near the next is along each axis.
"""

import numpy as np

from sharpfield.ops.fast._kernel import kernel
from sharpfield.ops.fast._lanes import lanes_for, load, store

FOUR = lanes_for(4)
"""Raw density and raw colour."""


@kernel
def new_spot():
    """Room for one."""
    return np.empty(4, np.float32), np.empty(3, np.int64), np.empty(3, np.float32)


@kernel
def point_on(rays, ray, z):
    """The point of a ray at `z`."""
    origin, direction = rays[0], rays[1]
    return (
        origin[ray, 0] + z * direction[ray, 0],
        origin[ray, 1] + z * direction[ray, 1],
        origin[ray, 2] + z * direction[ray, 2],
    )


@kernel
def inside(point):
    """Whether a point is in the box."""
    x, y, z = point
    return -1.0 <= x <= 1.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 1.0


@kernel
def locate(grid, point, spot):
    """Find a point inside the box among the cells of a grid."""
    _, first, nearness = spot
    for axis in range(3):
        size = grid.shape[2 - axis]
        at = (point[axis] + 1.0) * 0.5 * (size - 1)
        first[axis] = min(int(at), size - 2)
        nearness[axis] = np.float32(at - first[axis])


@kernel
def corner(spot, number):
    """Indices of a corner along z, y and x."""
    first = spot[1]
    return first[2] + (number >> 2), first[1] + (number >> 1 & 1), first[0] + (number & 1)


@kernel
def share_of_corner(spot, number, whole):
    """The share of a corner in a `whole` that all eight have together."""
    x, y, z = spot[2]
    whole *= z if number & 4 else np.float32(1.0) - z
    whole *= y if number & 2 else np.float32(1.0) - y
    return whole * (x if number & 1 else np.float32(1.0) - x)


@kernel
def look(grids, point, spot):
    """Add what all grids hold at a point to the values of a spot."""
    for level in range(len(grids)):
        grid = grids[level]
        locate(grid, point, spot)
        found = load(spot[0], 0, FOUR)
        for number in range(8):
            z, y, x = corner(spot, number)
            at = 4 * ((z * grid.shape[1] + y) * grid.shape[2] + x)
            found += load(grid, at, FOUR) * share_of_corner(spot, number, np.float32(1.0))
        store(spot[0], 0, found)


@kernel
def add(grids, point, spot):
    """Add the values of a spot to all grids at a point: the way back of `look`."""
    for level in range(len(grids)):
        grid = grids[level]
        locate(grid, point, spot)
        added = load(spot[0], 0, FOUR)
        for number in range(8):
            z, y, x = corner(spot, number)
            at = 4 * ((z * grid.shape[1] + y) * grid.shape[2] + x)
            w = share_of_corner(spot, number, np.float32(1.0))
            store(grid, at, load(grid, at, FOUR) + added * w)
