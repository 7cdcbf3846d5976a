import pytest
import torch

from sharpfield.losses.photometric import mse


def test_nothing_is_lost_where_they_agree():
    image = torch.rand(5, 3)
    assert mse(image, image) == 0


def test_it_is_the_mean_over_pixels_and_channels():
    a, b = torch.rand(4, 3), torch.rand(4, 3)
    total = sum((a[i, c] - b[i, c]).item() ** 2 for i in range(4) for c in range(3))
    assert mse(a, b).item() == pytest.approx(total / 12)


def test_gradients():
    a = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: mse(x, torch.zeros_like(x)), a)


def test_shapes_that_would_broadcast_are_refused():
    with pytest.raises(Exception, match="type-check|Type-check"):
        mse(torch.rand(4, 3), torch.rand(4, 1))
