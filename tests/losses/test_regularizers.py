import pytest
import torch

from sharpfield.losses.regularizers import alignment, smoothness


def slow_variation(grid: torch.Tensor) -> float:
    """2 (sum (d_h x)^2 / (C (H-1) W) + sum (d_w x)^2 / (C H (W-1))), as published; [h, w, c]."""
    h, w, c = grid.shape
    down = sum((grid[i + 1] - grid[i]).square().sum().item() for i in range(h - 1))
    across = sum((grid[:, j + 1] - grid[:, j]).square().sum().item() for j in range(w - 1))
    total = down / (c * (h - 1) * w)
    return 2 * (total + (across / (c * h * (w - 1)) if w > 1 else 0.0))


def test_constant_features_are_smooth():
    assert smoothness([torch.ones(4, 5, 2)], [torch.ones(6, 2)]) == 0


def test_it_is_the_published_sum():
    planes = [torch.randn(4, 5, 3), torch.randn(6, 2, 2)]
    lines = [torch.randn(7, 3), torch.randn(3, 2)]
    expected = sum(5 * 1e-2 * slow_variation(plane) for plane in planes)
    expected += sum(5 * 1e-3 * slow_variation(line[:, None]) for line in lines)
    assert smoothness(planes, lines).item() == pytest.approx(expected, rel=1e-5)


def test_a_kernel_on_its_pixel_is_aligned():
    offset, origin = torch.randn(4, 5, 2), torch.randn(4, 5, 2)
    offset[:, 0], origin[:, 0] = 0, 0
    assert alignment(offset, origin) < 2e-5


def test_alignment_is_the_mean_distance_of_the_first_ray():
    offset, origin = torch.randn(4, 5, 2), torch.randn(4, 5, 2)
    expected = sum(offset[b, 0].norm().item() + 10 * origin[b, 0].norm().item() for b in range(4))
    assert alignment(offset, origin).item() == pytest.approx(expected / 4, rel=1e-5)


def test_gradients():
    plane, line = (
        torch.randn(s, dtype=torch.float64, requires_grad=True) for s in ((3, 4, 2), (5, 2))
    )
    assert torch.autograd.gradcheck(lambda p, x: smoothness([p], [x]), (plane, line))
    bent = torch.randn(2, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: alignment(x, 0.1 * x), bent)


def test_the_slope_of_a_perfect_alignment_is_finite():
    offset = torch.zeros(4, 5, 2, requires_grad=True)
    alignment(offset, offset).backward()
    assert offset.grad is not None and offset.grad.isfinite().all()
