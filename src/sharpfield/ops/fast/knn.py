# pyright: basic
"""Neighbours and near places on the CPU, query after query.

Cells that lie farther off than the worst neighbour so far are not looked into.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.ops.fast._kernel import kernel, memory, share, spread
from sharpfield.ops.knn import BRICK, SIDE, Cells, chosen, first_near, neighbours, ways, window


@neighbours.accelerate("cpu", needs="numba")
def _(
    queries: Float[Tensor, "q 3"],
    points: Float[Tensor, "n 3"],
    cells: Cells,
    most: int,
    radius: float,
) -> tuple[Int64[Tensor, "q k"], Float[Tensor, "q k 3"]]:
    rows = torch.from_numpy(np.empty((len(queries), most), np.int64))
    steps = np.array(window(cells.reach), np.int64)
    lists = memory(cells.start), memory(cells.places), memory(cells.order), steps
    spread(_search, memory(queries.contiguous()), _frame(cells), lists, radius**2, memory(rows))
    return rows, ways(queries, points, rows)


@first_near.accelerate("cpu", needs="numba")
def _(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    place: Float[Tensor, "b d"],
    cells: Cells,
    most: int,
) -> tuple[Int64[Tensor, "b s"], Float[Tensor, "b s 3"]]:
    which = torch.from_numpy(np.empty((len(origin), most), np.int64))
    rays = tuple(memory(part.contiguous()) for part in (origin, direction, place))
    spread(_march, rays, _frame(cells), memory(cells.near), memory(which))
    return which, chosen(origin, direction, place, which)


def _frame(cells: Cells):
    """Where cells are, and the table of bricks."""
    return np.array(cells.origin), 1 / cells.edge, memory(cells.table)


@kernel
def _cell(x, y, z, table):
    """The number of a cell, -1 outside or where no point is near."""
    if x < 0 or y < 0 or z < 0:
        return -1
    a, b, c = x // SIDE, y // SIDE, z // SIDE
    if a >= table.shape[0] or b >= table.shape[1] or c >= table.shape[2]:
        return -1
    brick = np.int64(table[a, b, c])
    if brick < 0:
        return -1
    return brick * BRICK + ((x - a * SIDE) * SIDE + y - b * SIDE) * SIDE + z - c * SIDE


@kernel
def _gap(place, step):
    """How far a query at `place` (0...1) of its cell is from the cell `step` further, in cells."""
    if step == 0:
        return 0.0
    return step - place if step > 0 else place - step - 1


@kernel
def _search(worker, workers, queries, frame, lists, farthest, rows):
    """The nearest points of a share of the queries."""
    origin, inverse, table = frame
    start, places, order, steps = lists
    most = rows.shape[1]
    away = np.empty(most)
    for q in range(*share(worker, workers, len(queries))):
        qx, qy, qz = queries[q, 0], queries[q, 1], queries[q, 2]
        x, y, z = (qx - origin[0]) * inverse, (qy - origin[1]) * inverse, (qz - origin[2]) * inverse
        cx, cy, cz = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
        found = 0
        limit = farthest
        for w in range(len(steps)):
            sx, sy, sz = steps[w, 0], steps[w, 1], steps[w, 2]
            gx, gy, gz = _gap(x - cx, sx), _gap(y - cy, sy), _gap(z - cz, sz)
            # A little less, so that rounding hides no point.
            if 0.9999 * (gx * gx + gy * gy + gz * gz) > limit * inverse * inverse:
                continue
            cell = _cell(cx + sx, cy + sy, cz + sz, table)
            if cell < 0:
                continue
            for item in range(start[cell], start[cell + 1]):
                dx, dy, dz = places[item, 0] - qx, places[item, 1] - qy, places[item, 2] - qz
                d = dx * dx + dy * dy + dz * dz
                if d >= limit:
                    continue
                at = min(found, most - 1)
                while at > 0 and away[at - 1] > d:
                    away[at] = away[at - 1]
                    rows[q, at] = rows[q, at - 1]
                    at -= 1
                away[at] = d
                rows[q, at] = order[item]
                found = min(found + 1, most)
                if found == most:
                    limit = away[most - 1]
        for at in range(found, most):
            rows[q, at] = -1


@kernel
def _march(worker, workers, rays, frame, near, which):
    """The first near places of a share of the rays."""
    origins, directions, places = rays
    origin, inverse, table = frame
    for ray in range(*share(worker, workers, len(which))):
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        found = 0
        for s in range(places.shape[1]):
            t = places[ray, s]
            x = np.int64(np.floor((ox + t * dx - origin[0]) * inverse))
            y = np.int64(np.floor((oy + t * dy - origin[1]) * inverse))
            z = np.int64(np.floor((oz + t * dz - origin[2]) * inverse))
            cell = _cell(x, y, z, table)
            if cell >= 0 and near[cell]:
                which[ray, found] = s
                found += 1
                if found == which.shape[1]:
                    break
        for s in range(found, which.shape[1]):
            which[ray, s] = -1
