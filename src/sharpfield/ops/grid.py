"""Features looked up in planes and lines that factor a volume, and their total variation.

Vocabulary: a *plane* `[h, w, c]` and a *line* `[l, c]` hold features at their cells, channels last,
so that the features of a cell lie side by side in memory. A *volume* is three pairs, each the
product of a plane along two axes and a line along the third. Points are in box coordinates: -1 and
1 are the centres of the first and last cell along each axis. Lookups are (bi)linear; cells outside
count as zero, so a feature fades out over one cell beyond the box and is zero further off.

Source: vector-matrix factorisation, TensoRF (ECCV 2022), eq. 3; shapes from PDRF (AAAI 2023).
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sharpfield.ops._dispatch import Op

PAIRS = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
"""Of each pair: the axis along the plane's columns, along its rows, and along the line."""


def grid_shape(box: Float[Tensor, "2 3"], voxels: int) -> tuple[int, int, int]:
    """Cells along x, y and z so that cubic voxels fill a box with about `voxels` of them.

    The edge is h = (dx dy dz / voxels)^(1/3); each axis gets floor(extent / h) cells, at least 2.

    Args:
        box: Low and high corner.
        voxels: Budget of the whole box.
    """
    extent = [float(side) for side in box[1].double() - box[0].double()]
    edge = (math.prod(extent) / voxels) ** (1 / 3)
    x, y, z = (max(int(length / edge), 2) for length in extent)
    return x, y, z


def plane_features(
    points: Float[Tensor, "*b 2"], plane: Float[Tensor, "h w c"]
) -> Float[Tensor, "*b c"]:
    """Bilinear lookup in one plane.

    Args:
        points: Column and row in box coordinates.
        plane: Features by row and column.
    """
    grid = points.reshape(1, 1, -1, 2)
    image = plane.permute(2, 0, 1)[None]
    found = F.grid_sample(image, grid, padding_mode="zeros", align_corners=True)
    return found[0, :, 0].T.reshape(*points.shape[:-1], plane.shape[-1])


def line_features(points: Float[Tensor, "*b"], line: Float[Tensor, "l c"]) -> Float[Tensor, "*b c"]:
    """Linear lookup in one line.

    Args:
        points: Position along the line in box coordinates.
        line: Features by cell.
    """
    on_plane = torch.stack([torch.zeros_like(points), points], -1)
    return plane_features(on_plane, line[:, None])


@Op
def plane_line_features(
    points: Float[Tensor, "*b 3"],
    planes: Sequence[Float[Tensor, "_ _ _"]],
    lines: Sequence[Float[Tensor, "_ _"]],
) -> Float[Tensor, "*b f"]:
    """Features of a volume: plane times line of each pair, one pair after the other.

    Args:
        points: x, y and z in box coordinates.
        planes: xy `[y, x, c0]`, xz `[z, x, c1]` and yz `[z, y, c2]`.
        lines: z `[z, c0]`, y `[y, c1]` and x `[x, c2]`.

    Returns:
        c0 + c1 + c2 features per point.
    """
    pairs = [
        plane_features(points[..., (column, row)], plane) * line_features(points[..., along], line)
        for (column, row, along), plane, line in zip(PAIRS, planes, lines, strict=True)
    ]
    return torch.cat(pairs, -1)


@Op
def plane_line_mixture(
    points: Float[Tensor, "*b 3"],
    planes: Sequence[Float[Tensor, "_ _ _"]],
    lines: Sequence[Float[Tensor, "_ _"]],
    basis: Float[Tensor, "f m"],
) -> Float[Tensor, "*b m"]:
    """Features of a volume times one matrix: `plane_line_features(...) @ basis`.

    A version may work through the points in chunks, so that the wide features of all points are
    never in memory at once.

    Args:
        points: See `plane_line_features`.
        planes: See `plane_line_features`.
        lines: See `plane_line_features`.
        basis: A column of weights per mixed feature; the transpose of a linear layer's weight.
    """
    return plane_line_features.reference(points, planes, lines) @ basis


def _example_volume(
    generator: torch.Generator, size: int
) -> tuple[Float[Tensor, "n 3"], list[Float[Tensor, "_ _ _"]], list[Float[Tensor, "_ _"]]]:
    """Points in a box and a little outside, and a volume of 9, 7 and 11 cells times `size`."""
    x, y, z = 9 * size, 7 * size, 11 * size
    xy, xz, yz = 32, 16, 16

    def values(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    points = 2.4 * torch.rand(40 * size**2, 3, generator=generator) - 1.2
    planes = [values(y, x, xy), values(z, x, xz), values(z, y, yz)]
    return points, planes, [values(z, xy), values(y, xz), values(x, yz)]


@plane_line_features.exemplify
def _features_example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    return _example_volume(generator, size)


@plane_line_mixture.exemplify
def _mixture_example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    points, planes, lines = _example_volume(generator, size)
    return points, planes, lines, torch.randn(64, 8, generator=generator)


@Op
def total_variation(grid: Float[Tensor, "*size c"]) -> Float[Tensor, ""]:
    """Total variation: twice the mean squared difference of neighbours, summed over the axes.

    Args:
        grid: A plane `[h, w, c]` or a line `[l, c]`, channels last. An axis of one cell has no
            neighbours and adds nothing.

    Source: TensoRF (ECCV 2022), the regulariser of its planes and lines; PDRF (AAAI 2023).
    """
    total = grid.new_zeros(())
    for axis, cells in enumerate(grid.shape[:-1]):
        if cells > 1:
            total = total + 2 * grid.diff(dim=axis).square().mean()
    return total


@total_variation.exemplify
def _variation_example(generator: torch.Generator, size: int) -> tuple[Float[Tensor, "h w c"]]:
    return (torch.randn(7 * size, 5 * size, 6, generator=generator),)
