"""Total variation against its definition in a loop."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sharpfield.ops._dispatch import using
from sharpfield.ops.grid import total_variation


@pytest.fixture(params=["reference", "fast"], autouse=True)
def version(request: pytest.FixtureRequest):
    with using(request.param):
        yield


def slow_plane(x: np.ndarray) -> float:
    height, width, channels = x.shape
    down = right = 0.0
    for c in range(channels):
        for i in range(height):
            for j in range(width):
                if i + 1 < height:
                    down += (x[i + 1, j, c] - x[i, j, c]) ** 2
                if j + 1 < width:
                    right += (x[i, j + 1, c] - x[i, j, c]) ** 2
    return 2 * (
        down / (channels * (height - 1) * width) + right / (channels * height * (width - 1))
    )


def grid(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_constant_grid_has_none() -> None:
    x = torch.full((4, 5, 3), 7.0, requires_grad=True)
    value = total_variation(x)
    value.backward()
    assert value == 0
    assert x.grad is not None and not x.grad.any()


def test_scales_with_the_square() -> None:
    x = grid(4, 5, 3)
    torch.testing.assert_close(total_variation(3 * x), 9 * total_variation(x))


@pytest.mark.parametrize("shape", [(4, 5, 3), (2, 2, 16), (9, 3, 1)])
def test_plane_equals_the_loop(shape: tuple[int, ...]) -> None:
    x = grid(*shape)
    assert total_variation(x).item() == pytest.approx(slow_plane(x.numpy()), rel=1e-12)


def test_line_has_only_the_first_term() -> None:
    x = grid(6, 4)
    expected = 2 * np.square(np.diff(x.numpy(), axis=0)).sum() / (4 * 5)
    assert total_variation(x).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("shape", [(4, 5, 3), (1, 5, 2), (5, 1, 2), (6, 4), (7, 16)])
def test_gradient(shape: tuple[int, ...]) -> None:
    assert torch.autograd.gradcheck(total_variation, grid(*shape).requires_grad_())


def test_grid_of_one_cell_has_none() -> None:
    assert total_variation(grid(1, 1, 3)) == 0
    assert total_variation(grid(1, 3)) == 0


def test_large_grid_keeps_its_digits() -> None:
    x = grid(300, 200, 16)
    torch.testing.assert_close(
        total_variation(x.float()).double(), total_variation(x), rtol=3e-6, atol=0
    )
