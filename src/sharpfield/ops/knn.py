"""Nearest neighbours of positions, and samples of rays near points, among millions of points.

Vocabulary: space is divided into cubic *cells*, and 4x4x4 cells form a *brick*. Only bricks near
points are stored; a small *table* holds the number of each. Points are listed cell after cell. A
cell is *near* if it, or one of the cells around it (the *window*), contains a point. The structure
is built once for static points; memory and time grow with the number of points and not with the
space between them.

Source: the query of Point-NeRF (CVPR 2022), section 4.1, which rebuilds a dense grid for every
batch, keeps a random choice of points where a cell is full, and stops at the first cells that hold
enough; here neighbours are the exact nearest within the window.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from sharpfield.core.errors import OptionError
from sharpfield.ops._dispatch import Op

HALF, BITS = 2, 6
"""Bits of one coordinate of a cell inside its brick, and of all three."""

SIDE, BRICK = 1 << HALF, 1 << BITS
"""Cells along the edge of a brick, and in it."""

MOST_BRICKS = 1 << 28
"""Of the table: 1 GiB."""

CHUNK = 1 << 14
"""Queries that the reference processes at once."""

HELD = 1 << 16
"""Cells whose windows are processed at once: few enough for the CPU's cache."""


@dataclass(frozen=True)
class Cells:
    """Points sorted into cells."""

    origin: tuple[float, float, float]
    """Low corner of the first cell."""
    edge: float
    """Of a cell, in world units."""
    reach: int
    """The window is this many cells wide to each side."""
    table: Int32[Tensor, "x y z"]
    """Number of each brick; -1 where no point is near."""
    start: Int32[Tensor, "m"]
    """Start of each cell's list; cell c of brick b is 64 b + c. The last entry is the count."""
    near: Bool[Tensor, "k"]
    """Cells that have points in their window."""
    order: Int64[Tensor, "n"]
    """The points, cell after cell."""
    places: Float[Tensor, "n 3"]
    """Their positions, in that order."""


def sort_into_cells(points: Float[Tensor, "n 3"], edge: float, *, reach: int = 1) -> Cells:
    """Build the cell lists in which neighbours are looked up.

    Args:
        points: At least one.
        edge: Of a cell. All neighbours within `reach * edge` are found; farther ones only if they
            are in the window.
        reach: Cells by which the window extends to each side.

    Raises:
        OptionError: Points are spread over more bricks than the table may have.
    """
    points = points.detach()
    low = points.amin(0) - (reach + 0.5) * edge
    cell = ((points - low) / edge).floor().long()
    bricks = [(int(most) + reach) // SIDE + 1 for most in cell.amax(0)]
    assert 0 <= reach <= SIDE, f"windows reach at most one brick further, not {reach} cells"
    if bricks[0] * bricks[1] * bricks[2] > MOST_BRICKS:
        extent = points.amax(0) - points.amin(0)
        raise OptionError(
            "points are spread too far for cells so small",
            got=f"{len(points)} points over {extent[0]:.3g} x {extent[1]:.3g} x {extent[2]:.3g}"
            f" in cells of {edge:.3g}",
            do="use larger voxels, or leave out distant points",
        )
    key = _key(cell, bricks)
    key, order = key.sort(stable=True)
    changed = torch.ones_like(key, dtype=torch.bool)
    changed[1:] = key[1:] != key[:-1]
    first = torch.nonzero(changed)[:, 0]
    held = key[first]
    count = torch.cat([first, first.new_tensor([len(key)])]).diff()
    marked = torch.zeros(bricks[0] * bricks[1] * bricks[2], dtype=torch.bool, device=key.device)
    corners = list(itertools.product(sorted({-reach, reach}), repeat=3))
    for around in _around(held, bricks, corners):
        marked[around >> BITS] = True
    number = torch.where(marked, marked.cumsum(0, dtype=torch.int32) - 1, -1).int()
    cells = int(marked.sum()) * BRICK
    near = torch.zeros(cells, dtype=torch.bool, device=key.device)
    for around in _around(held, bricks, window(reach)):
        near[number[around >> BITS].long() * BRICK + (around & BRICK - 1)] = True
    counts = torch.zeros(cells + 1, dtype=torch.int64, device=key.device)
    counts[number[held >> BITS].long() * BRICK + (held & BRICK - 1) + 1] = count
    return Cells(
        origin=(float(low[0]), float(low[1]), float(low[2])),
        edge=edge,
        reach=reach,
        table=number.view(*bricks),
        start=counts.cumsum(0).int(),
        near=near,
        order=order,
        places=points[order].contiguous(),
    )


def window(reach: int) -> list[tuple[int, int, int]]:
    """Offsets of the cells of a window: the central one first."""
    steps = range(-reach, reach + 1)
    around = [(x, y, z) for x in steps for y in steps for z in steps]
    return sorted(around, key=lambda step: step != (0, 0, 0))


@Op
def neighbours(
    queries: Float[Tensor, "q 3"],
    points: Float[Tensor, "n 3"],
    cells: Cells,
    most: int,
    radius: float,
) -> tuple[Int64[Tensor, "q k"], Float[Tensor, "q k 3"]]:
    """The nearest points within a radius, in the window of each query's cell.

    Args:
        queries: Anywhere; outside of all bricks nothing is found.
        points: Those that were sorted into cells.
        cells: Made of the points.
        most: The number k of neighbours.
        radius: They are closer than this.

    Returns:
        Rows of the points, near to far, -1 where there are no more; and the offset from the query
        to each of them, zero where there is none.
    """
    begins = range(0, len(queries), CHUNK)
    detached = queries.detach()
    parts = [_nearest(detached[i : i + CHUNK], cells, most, radius) for i in begins]
    rows = torch.cat(parts) if parts else queries.new_zeros(0, most, dtype=torch.int64)
    return rows, ways(queries, points, rows)


@neighbours.exemplify
def _near_example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    points = torch.rand(150 * size, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.2])
    queries = torch.rand(40 * size, 3, generator=generator) * torch.tensor([1.2, 1.2, 0.2]) - 0.1
    return queries, points, sort_into_cells(points, 0.1), 6, 0.15


@Op
def first_near(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    place: Float[Tensor, "b d"],
    cells: Cells,
    most: int,
) -> tuple[Int64[Tensor, "b s"], Float[Tensor, "b s 3"]]:
    """The first samples on rays that are in cells near points.

    Args:
        origin: Of rays.
        direction: Change of position per unit of `place`.
        place: Ray parameters of the samples, ascending.
        cells: Made of the points.
        most: The number s of samples for each ray.

    Returns:
        Indices of the samples, -1 where there are no more; and their positions, zero where there
        are none.
    """
    at = along(origin.detach(), direction.detach(), place.detach())
    near = _cell_of(at, cells) >= 0
    near &= cells.near[_cell_of(at, cells).clamp_min(0)]
    first = near.byte().argsort(dim=-1, descending=True, stable=True)[:, :most]
    first = torch.where(near.gather(-1, first), first, -1)
    first = torch.nn.functional.pad(first, (0, most - first.shape[1]), value=-1)
    return first, chosen(origin, direction, place, first)


@first_near.exemplify
def _march_example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    points = torch.rand(60 * size, 3, generator=generator)
    origin = torch.rand(10 * size, 3, generator=generator) - torch.tensor([0.0, 0.0, 1.5])
    toward = torch.tensor([0.0, 0.0, 1.0]) + 0.2 * torch.randn(10 * size, 3, generator=generator)
    place = 3 * torch.rand(10 * size, 50, generator=generator).sort(-1).values
    return origin, toward, place, sort_into_cells(points, 0.08), 7


def ways(
    queries: Float[Tensor, "q 3"], points: Float[Tensor, "n 3"], rows: Int64[Tensor, "q k"]
) -> Float[Tensor, "q k 3"]:
    """Offsets from queries to their neighbours; zero where there is none."""
    to = points.index_select(0, rows.clamp_min(0).flatten()).view(*rows.shape, 3)
    return (to - queries[:, None]) * (rows >= 0)[..., None]


def along(
    origin: Float[Tensor, "b 3"], direction: Float[Tensor, "b 3"], place: Float[Tensor, "b s"]
) -> Float[Tensor, "b s 3"]:
    """Points on rays."""
    return origin[:, None] + place[..., None] * direction[:, None]


def chosen(
    origin: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    place: Float[Tensor, "b d"],
    which: Int64[Tensor, "b s"],
) -> Float[Tensor, "b s 3"]:
    """Points on rays at selected samples; zero where there is none."""
    at = along(origin, direction, place.gather(-1, which.clamp_min(0)))
    return at * (which >= 0)[..., None]


def _key(cell: Int64[Tensor, "n 3"], bricks: list[int]) -> Int64[Tensor, "n"]:
    """One number for each cell, brick after brick."""
    x, y, z = (_along(cell[:, axis], axis, bricks) for axis in range(3))
    return x + y + z


def _along(place: Int64[Tensor, "n"], axis: int, bricks: list[int]) -> Int64[Tensor, "n"]:
    """Contribution of one coordinate of cells to their keys; the bits of the three are disjoint."""
    apart = math.prod(bricks[axis + 1 :]) << BITS
    return (place >> HALF) * apart + ((place & SIDE - 1) << HALF * (2 - axis))


def _around(
    keys: Int64[Tensor, "m"], bricks: list[int], steps: Sequence[tuple[int, ...]]
) -> Iterator[Int64[Tensor, "_"]]:
    """Keys of the cells some steps away, for a limited number of cells at a time."""
    offsets = sorted({offset for step in steps for offset in step})
    for begin in range(0, len(keys), HELD):
        axes = enumerate(_cell_of_key(keys[begin : begin + HELD], bricks).unbind(-1))
        moved = [{one: _along(x + one, axis, bricks) for one in offsets} for axis, x in axes]
        for x, y, z in steps:
            yield moved[0][x] + moved[1][y] + moved[2][z]


def _cell_of_key(key: Int64[Tensor, "n"], bricks: list[int]) -> Int64[Tensor, "n 3"]:
    """The inverse of `_key`."""
    brick, inner = key >> BITS, key & BRICK - 1
    at = [
        brick // (bricks[1] * bricks[2]) << HALF | inner >> 2 * HALF,
        brick // bricks[2] % bricks[1] << HALF | inner >> HALF & SIDE - 1,
        brick % bricks[2] << HALF | inner & SIDE - 1,
    ]
    return torch.stack(at, -1)


def _cell_of(places: Float[Tensor, "*b 3"], cells: Cells) -> Int64[Tensor, "*b"]:
    """Number of the cell of each position, -1 where no point is near."""
    low = places.new_tensor(cells.origin)
    return _number(((places - low) / cells.edge).floor().long(), cells)


def _number(cell: Int64[Tensor, "*b 3"], cells: Cells) -> Int64[Tensor, "*b"]:
    bricks = list(cells.table.shape)
    inside = ((cell >= 0) & (cell < SIDE * cell.new_tensor(bricks))).all(-1)
    key = _key(torch.where(inside[..., None], cell, 0).reshape(-1, 3), bricks).view(inside.shape)
    brick = cells.table.flatten()[key >> BITS].long()
    return torch.where(inside & (brick >= 0), brick * BRICK + (key & BRICK - 1), -1)


def _nearest(
    queries: Float[Tensor, "q 3"], cells: Cells, most: int, radius: float
) -> Int64[Tensor, "q k"]:
    """Rows of the nearest points of a few queries, by comparing all points of their windows."""
    own = ((queries - queries.new_tensor(cells.origin)) / cells.edge).floor().long()
    steps = torch.tensor(window(cells.reach), device=queries.device)
    cell = _number(own[:, None] + steps, cells)  # [q, w]
    begin = cells.start.long()[cell.clamp_min(0)]
    count = torch.where(cell >= 0, cells.start.long()[cell.clamp_min(0) + 1] - begin, 0)
    slot = torch.arange(max(int(count.max()), 1) if len(cell) else 1, device=queries.device)
    valid = (slot < count[..., None]).flatten(1)  # [q, w slots]
    item = (begin[..., None] + slot).flatten(1).clamp_max(len(cells.order) - 1)
    away = (cells.places.to(queries.dtype)[item] - queries[:, None]).square().sum(-1)
    away = torch.where(valid & (away < radius**2), away, torch.inf)
    away = torch.nn.functional.pad(away, (0, most), value=torch.inf)
    item = torch.nn.functional.pad(item, (0, most))
    away, best = away.sort(dim=-1, stable=True)
    rows = cells.order[item.gather(-1, best[:, :most])]
    return torch.where(away[:, :most].isfinite(), rows, -1)
