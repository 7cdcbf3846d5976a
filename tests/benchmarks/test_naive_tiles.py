"""The naive tiles are a fair opponent only if they compute the same."""

import pytest
import torch
from torch import Tensor

from benchmarks import naive_tiles
from benchmarks.rasterize import SCENES, scene
from sharpfield.ops.rasterizer import rasterize


def value_and_gradients(draw, arguments: list) -> list[Tensor]:
    *tensors, canvas = arguments
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    drawn = draw(*leaves, canvas)
    made = torch.Generator().manual_seed(0)
    loss = sum((image * torch.randn(image.shape, generator=made)).sum() for image in drawn)
    return [*drawn, *torch.autograd.grad(loss, leaves)]


@pytest.mark.parametrize("views", [1, 2])
def test_the_naive_tiles_are_the_definition(views: int) -> None:
    arguments = scene(300, (50, 37), 1.5, views)
    found = value_and_gradients(naive_tiles.rasterize, arguments)
    wanted = value_and_gradients(rasterize.reference, arguments)
    for one, other in zip(found, wanted, strict=True):
        assert other.abs().max() > 0
        error = (one - other).abs().max() / other.abs().max()
        assert error < 1e-3, f"off by {error:.1e} of the largest value"


def test_scenes_are_those_that_were_asked_for() -> None:
    sizes = {name: (made[0], made[1]) for name, made in SCENES.items()}
    assert (30_000, (346, 260)) in sizes.values() and (5_000, (200, 133)) in sizes.values()
