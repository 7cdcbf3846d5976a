import pytest
import torch
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Radiance, Rays
from sharpfield.geometry import se3
from sharpfield.rendering.view import render_view

CAMERA = Camera(7, 5, 6.0, 6.0, 3.5, 2.5)
POSE = se3.exp(torch.tensor([0.1, -0.3, 0.2, 1.0, 2.0, 3.0]))


def sky(rays: Rays) -> Radiance:
    """Light that tells direction, origin and time apart."""
    rgb = rays.direction * 0.5 + 0.5
    return Radiance(
        rgb, rays.origin.sum(-1), rays.time, rays.weight, Radiance(rgb, *[rays.time] * 3)
    )


@pytest.mark.parametrize("chunk", [1, 4, 34, 35, 36, 4096])
def test_every_pixel_is_seen_once_whatever_the_chunk(chunk: int):
    view = render_view(sky, CAMERA, POSE, 0.25, chunk=chunk)
    wanted = torch.empty(5, 7, 3)
    for row in range(5):
        for column in range(7):
            inside = CAMERA.direction(torch.tensor([column + 0.5, row + 0.5]))
            wanted[row, column] = se3.rotate(POSE, inside) * 0.5 + 0.5
    assert view.shape == (5, 7)
    torch.testing.assert_close(view.rgb, wanted)
    torch.testing.assert_close(view.depth, POSE[:, 3].sum().expand(5, 7))
    assert (view.opacity == 0.25).all() and (view.weight == 1).all()
    assert view.coarse is None


def test_progress_counts_pixels():
    said: list[tuple[int, int]] = []
    render_view(sky, CAMERA, POSE, 0.0, chunk=16, progress=lambda *done: said.append(done))
    assert said == [(16, 35), (32, 35), (35, 35)]


def test_no_gradient_is_kept():
    scale = torch.ones(3, requires_grad=True)

    def tinted(rays: Rays) -> Radiance:
        seen = sky(rays)
        rgb: Tensor = seen.rgb * scale
        return Radiance(rgb, seen.depth, seen.opacity, seen.weight)

    assert not render_view(tinted, CAMERA, POSE, 0.0).rgb.requires_grad
