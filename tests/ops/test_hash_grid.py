"""Hash grids: interpolation laws, and the layout of the paper."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from sharpfield.ops._dispatch import using
from sharpfield.ops.hash_grid import entries_of_corners, hash_features, hash_layout

LAYOUT = hash_layout(levels=3, coarsest=3, growth=1.7, table_bits=8)


@pytest.fixture(params=["reference", "fast"], autouse=True)
def version(request: pytest.FixtureRequest):
    with using(request.param):
        yield


def table() -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(sum(LAYOUT.entries), 2, generator=generator, dtype=torch.float64)


def test_layout_is_dense_until_the_table_is_full() -> None:
    assert LAYOUT.cells == (3, 5, 8)
    assert LAYOUT.entries == (64, 216, 256)
    assert LAYOUT.hashed == (False, False, True)
    assert LAYOUT.starts == (0, 64, 280)


def test_dense_levels_give_each_corner_its_own_entry() -> None:
    corners = torch.tensor(list(itertools.product(range(6), repeat=3)))
    entries = entries_of_corners(corners, 5, 216, hashed=False)
    assert sorted(entries.tolist()) == list(range(216))


def test_hash_is_that_of_32_bit_arithmetic() -> None:
    corners = torch.tensor([[1, 2, 3], [1023, 2047, 4095], [0, 0, 1]])
    expected = [
        (x ^ (y * 2_654_435_761 % 2**32) ^ (z * 805_459_861 % 2**32)) % 2**19
        for x, y, z in corners.tolist()
    ]
    assert entries_of_corners(corners, 4095, 2**19, hashed=True).tolist() == expected


def test_constant_table_gives_the_constant() -> None:
    points = torch.rand(50, 3, dtype=torch.float64) * 3 - 1.5
    found = hash_features(points, torch.full_like(table(), 2.5), LAYOUT)
    torch.testing.assert_close(found, torch.full((50, 6), 2.5, dtype=torch.float64))


@pytest.mark.parametrize("level", [0, 1, 2])
def test_corners_of_each_level_are_found_exactly(level: int) -> None:
    cells = LAYOUT.cells[level]
    corners = torch.tensor(list(itertools.product(range(cells + 1), repeat=3)))
    entries = LAYOUT.starts[level] + entries_of_corners(
        corners, cells, LAYOUT.entries[level], hashed=LAYOUT.hashed[level]
    )
    found = hash_features(2 * corners.double() / cells - 1, table(), LAYOUT)
    torch.testing.assert_close(found[:, 2 * level : 2 * level + 2], table()[entries])


def test_trilinear_functions_are_exact() -> None:
    layout = hash_layout(levels=1, coarsest=4, growth=2.0, table_bits=10)
    z, y, x = torch.meshgrid(*[torch.linspace(-1, 1, 5, dtype=torch.float64)] * 3, indexing="ij")
    points = torch.rand(40, 3, dtype=torch.float64) * 2 - 1
    found = hash_features(points, (x * y * z + 2 * x - y).reshape(-1, 1), layout)
    px, py, pz = points.unbind(-1)
    torch.testing.assert_close(found[:, 0], px * py * pz + 2 * px - py)


def test_outside_is_like_the_nearest_point_inside() -> None:
    points = torch.rand(2, 10, 3, dtype=torch.float64) * 6 - 3
    torch.testing.assert_close(
        hash_features(points, table(), LAYOUT), hash_features(points.clamp(-1, 1), table(), LAYOUT)
    )


def test_gradients() -> None:
    generator = torch.Generator().manual_seed(1)
    points = (2.4 * torch.rand(10, 3, generator=generator).double() - 1.2).requires_grad_()
    arguments = points, table().requires_grad_(), LAYOUT
    assert torch.autograd.gradcheck(hash_features, arguments, fast_mode=True)


def test_no_points_give_no_features() -> None:
    assert hash_features(torch.zeros(0, 3).double(), table(), LAYOUT).shape == (0, 6)


def test_a_point_that_is_not_a_number_is_not_hidden() -> None:
    points = torch.tensor([[0.0, math.nan, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    found = hash_features(points, table(), LAYOUT)
    assert found[0].isnan().all()
    assert found[1].isfinite().all()
