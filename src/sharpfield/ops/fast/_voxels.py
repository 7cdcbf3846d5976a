# pyright: basic
"""What kernels do at the cells of a voxel grid `[d, h, w, 4]`: find them, read them, add to them.

Points are in box coordinates, see `ops.voxel_march`.
"""

import math

import numpy as np

from sharpfield.ops.fast._kernel import kernel, share


@kernel
def locate(grid, x, y, z, corner, weight):
    """The cell below a point along each axis, and the share of the next one; False outside."""
    depth, height, width = grid.shape[0], grid.shape[1], grid.shape[2]
    if not (-1.0 <= x <= 1.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 1.0):
        return False
    px = (x + 1.0) * 0.5 * (width - 1)
    py = (y + 1.0) * 0.5 * (height - 1)
    pz = (z + 1.0) * 0.5 * (depth - 1)
    corner[0] = min(int(px), width - 2)
    corner[1] = min(int(py), height - 2)
    corner[2] = min(int(pz), depth - 2)
    weight[0] = np.float32(px - corner[0])
    weight[1] = np.float32(py - corner[1])
    weight[2] = np.float32(pz - corner[2])
    return True


@kernel
def look(grid, corner, weight, found):
    """Add the trilinear values at a located point."""
    a, b, c, d = found[0], found[1], found[2], found[3]
    for k in range(2):
        wz = weight[2] if k else np.float32(1.0) - weight[2]
        for j in range(2):
            wy = wz * (weight[1] if j else np.float32(1.0) - weight[1])
            for i in range(2):
                w = wy * (weight[0] if i else np.float32(1.0) - weight[0])
                cell = grid[corner[2] + k, corner[1] + j, corner[0] + i]
                a += w * cell[0]
                b += w * cell[1]
                c += w * cell[2]
                d += w * cell[3]
    found[0], found[1], found[2], found[3] = a, b, c, d


@kernel
def softplus(raw):
    return raw if raw > 15.0 else math.log1p(math.exp(raw))


@kernel
def sigmoid(raw):
    return 1.0 / (1.0 + math.exp(-raw))


@kernel
def add(grid, corner, weight, a, b, c, d):
    """Add to the eight cells around a located point."""
    for k in range(2):
        wz = weight[2] if k else np.float32(1.0) - weight[2]
        for j in range(2):
            wy = wz * (weight[1] if j else np.float32(1.0) - weight[1])
            for i in range(2):
                w = wy * (weight[0] if i else np.float32(1.0) - weight[0])
                cell = grid[corner[2] + k, corner[1] + j, corner[0] + i]
                cell[0] += w * a
                cell[1] += w * b
                cell[2] += w * c
                cell[3] += w * d


@kernel
def merge(worker, workers, sums):
    """Add all parts to the first, slice by slice."""
    for level in range(len(sums)):
        total = sums[level]
        for z in range(*share(worker, workers, total.shape[1])):
            for part in range(1, len(total)):
                total[0, z] += total[part, z]
