import torch

from sharpfield.core.protocols import Formation
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma
from sharpfield.formation.ray_kernels import Bend, SparseKernel, SparsePoints
from sharpfield.formation.shutter import Pinhole
from tests.formation.toy import CAMERA, lit, pixels, swaying, wall


def points(**options) -> SparsePoints:
    return SparsePoints(3, CAMERA.size, generator=generator(0, 0, "points"), **options)


def kernel(learned: SparsePoints) -> SparseKernel:
    return SparseKernel(CAMERA, swaying(), learned, gamma)


def bend(offset: torch.Tensor, origin: torch.Tensor) -> Bend:
    return Bend(offset, origin, torch.full(offset.shape[:2], 1 / offset.shape[1]))


def test_it_is_a_formation():
    assert isinstance(kernel(points()), Formation)


def test_rays_that_are_not_bent_are_those_of_the_pinhole():
    seen, pinhole = pixels(), Pinhole(CAMERA, swaying(), gamma)
    straight = kernel(points()).follow(bend(torch.zeros(7, 5, 2), torch.zeros(7, 5, 2)), seen)
    torch.testing.assert_close(
        kernel(points()).observe(wall(straight), seen),
        pinhole.observe(wall(pinhole.expose(seen)), seen),
    )


def test_weights_sum_to_one():
    rays = kernel(points()).expose(pixels())
    assert rays.shape == (7, 5)
    torch.testing.assert_close(rays.weight.sum(1), torch.ones(7))


def test_a_bent_ray_leaves_a_shifted_camera_through_another_pixel():
    seen = pixels()
    offset, shift = torch.randn(7, 5, 2), 0.1 * torch.randn(7, 5, 2)
    rays = kernel(points()).follow(bend(offset, shift), seen)
    for b in range(7):
        pose = swaying().pose(seen.middle[b : b + 1], seen.track[:1])[0]
        for k in range(5):
            direction = pose[:, :3] @ CAMERA.direction(seen.xy[b] + offset[b, k])
            origin = pose[:, 3] + pose[:, :2] @ shift[b, k]
            torch.testing.assert_close(rays.direction[b, k], direction)
            torch.testing.assert_close(rays.origin[b, k], origin)


def test_the_kernel_varies_with_image_and_place():
    learned, seen = points(), pixels(2)
    same = type(seen)(*(getattr(seen, n)[:1].expand_as(getattr(seen, n)) for n in vars(seen)))
    there = type(same)(**{**vars(same), "xy": torch.tensor([[1.0, 1.0], [15.0, 11.0]])})
    other = type(same)(**{**vars(same), "frame": torch.tensor([0, 2])})
    assert torch.allclose(*learned(same).offset_px)
    assert not torch.allclose(*learned(there).offset_px)
    assert not torch.allclose(*learned(other).offset_px)


def test_it_starts_within_a_few_pixels():
    found = points()(pixels(50))
    assert 0.1 < found.offset_px.std() < 3
    assert found.origin.abs().max() < 0.02


def test_jitter_moves_points_by_the_generator_alone():
    learned, seen = points(), pixels()
    first = learned(seen, generator(1, 0, "jitter")).offset_px
    assert torch.equal(first, learned(seen, generator(1, 0, "jitter")).offset_px)
    moved = (first - learned(seen).offset_px).std()
    assert 0.5 < moved < 2.0  # a tenth of a window of ten pixels


def test_gradients_reach_every_parameter():
    learned, seen = points(), pixels()
    blur = kernel(learned)
    blur.observe(wall(blur.expose(seen)), seen).square().sum().backward()
    for name, parameter in learned.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_the_tone_curve_follows_the_sum():
    rgb = torch.rand(7, 5, 3)
    observed = kernel(points()).observe(lit(rgb, torch.full((7, 5), 0.2)), pixels())
    torch.testing.assert_close(observed, gamma(rgb.mean(1)))
