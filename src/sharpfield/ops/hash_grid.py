"""Multiresolution hash grid: features looked up in grids, the fine ones hashed into tables.

Vocabulary: a *level* is a grid of `cells` cubes per axis, so of cells + 1 corners. A level with no
more corners than a table has entries stores each corner in an entry of its own; finer levels share
entries by a hash of the corner, and training resolves collisions. All levels are consecutive in one
table `[entries, f]`. Points are in box coordinates, -1 to 1; points outside get the features of the
nearest point of the box.

Source: Instant-NGP (SIGGRAPH 2022), eqs. 1 to 4.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sharpfield.ops._dispatch import Op

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Of the hash, along x, y and z."""


@dataclass(frozen=True)
class HashLayout:
    """Sizes of the levels, and their entries in the table."""

    cells: tuple[int, ...]
    """Of each level along each axis."""
    entries: tuple[int, ...]
    """Of each level in the table."""
    hashed: tuple[bool, ...]

    @property
    def starts(self) -> tuple[int, ...]:
        """The first entry of each level."""
        return tuple(sum(self.entries[:level]) for level in range(len(self.entries)))


def hash_layout(*, levels: int, coarsest: int, growth: float, table_bits: int) -> HashLayout:
    """Levels of floor(coarsest growth^level) cells, in tables of at most 2^table_bits entries.

    Args:
        levels: How many; 16 in the paper.
        coarsest: Cells per axis of the first level; 16 in the paper.
        growth: From level to level; 1.26 to 2 in the paper.
        table_bits: 14 to 24 in the paper.
    """
    cells = tuple(int(coarsest * growth**level) for level in range(levels))
    corners = [(count + 1) ** 3 for count in cells]
    limit = 2**table_bits
    return HashLayout(
        cells=cells,
        entries=tuple(min(count, limit) for count in corners),
        hashed=tuple(count > limit for count in corners),
    )


def entries_of_corners(
    corners: Int[Tensor, "*b 3"], cells: int, entries: int, *, hashed: bool
) -> Int[Tensor, "*b"]:
    """Entries of the corners of one level, counted from the level's first entry (eq. 4)."""
    x, y, z = corners.unbind(-1)
    if not hashed:
        return x + (cells + 1) * (y + (cells + 1) * z)
    # The low bits of 64-bit products are those of the paper's 32-bit ones.
    return ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) % entries


@Op
def hash_features(
    points: Float[Tensor, "*b 3"], table: Float[Tensor, "n f"], layout: HashLayout
) -> Float[Tensor, "*b m"]:
    """Trilinear lookup in all levels, coarsest first.

    Args:
        points: x, y and z in box coordinates.
        table: Features of all entries of all levels.
        layout: Of the levels in the table.

    Returns:
        The f features of each level, one level after the other.
    """
    unit = (points.clamp(-1, 1) + 1) / 2
    found: list[Tensor] = []
    levels = zip(layout.cells, layout.entries, layout.hashed, layout.starts, strict=True)
    for cells, entries, hashed, start in levels:
        position = unit * cells
        # NaN stays NaN, in the fraction.
        low = position.detach().floor().clamp_max(cells - 1).nan_to_num()
        fraction = (position - low)[..., None, :]  # [*b, 1, 3]
        corner = torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3)  # [8, 3]
        which = low.long()[..., None, :] + corner  # [*b, 8, 3]
        weight = torch.where(corner == 1, fraction, 1 - fraction).prod(-1)  # [*b, 8]
        entry = start + entries_of_corners(which, cells, entries, hashed=hashed)
        found.append((weight[..., None] * table[entry]).sum(-2))
    return torch.cat(found, -1)


@hash_features.exemplify
def _(generator: torch.Generator, size: int) -> tuple[Tensor, Tensor, HashLayout]:
    """100 points times size^2, and levels of which the last two are hashed at size 1."""
    layout = hash_layout(levels=4, coarsest=4 * size, growth=1.5, table_bits=9)
    points = 2.4 * torch.rand(100 * size**2, 3, generator=generator) - 1.2
    return points, torch.randn(sum(layout.entries), 2, generator=generator), layout
