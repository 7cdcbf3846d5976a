from dataclasses import replace

import pytest
import torch

from sharpfield.core.protocols import Formation
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma
from sharpfield.formation.ray_kernels import ORIGIN, RigidKernel, RigidMotions
from sharpfield.formation.shutter import Pinhole
from tests.formation.toy import CAMERA, lit, pixels, swaying, wall


def motions(frames: int = 3, **options) -> RigidMotions:
    return RigidMotions(frames, generator=generator(0, 0, "motions"), **options)


def trained(frames: int = 3) -> RigidMotions:
    """With codes and heads that differ, as after some training."""
    made, random = motions(frames), generator(0, 0, "trained")
    with torch.no_grad():
        for parameter in made.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=random)
    return made


def kernel(learned: RigidMotions, centre: str = "world") -> RigidKernel:
    return RigidKernel(CAMERA, swaying(), learned, gamma, centre)


def test_it_is_a_formation():
    assert isinstance(kernel(motions()), Formation)


@pytest.mark.parametrize("centre", ["world", "camera"])
def test_without_motion_it_is_the_pinhole(centre):
    seen, pinhole = pixels(), Pinhole(CAMERA, swaying(), gamma)
    still = kernel(motions(window=0.0), centre)
    torch.testing.assert_close(
        still.observe(wall(still.expose(seen)), seen),
        pinhole.observe(wall(pinhole.expose(seen)), seen),
    )


@pytest.mark.parametrize("centre", ["world", "camera"])
def test_the_first_ray_is_the_unmoved_one(centre):
    seen = pixels()
    rays, sharp = kernel(trained(), centre).expose(seen), Pinhole(CAMERA, swaying()).expose(seen)
    torch.testing.assert_close(rays[:, ORIGIN].origin, sharp[:, 0].origin)
    torch.testing.assert_close(rays[:, ORIGIN].direction, sharp[:, 0].direction)


def test_weights_sum_to_one():
    weight = kernel(trained()).expose(pixels()).weight
    torch.testing.assert_close(weight.sum(1), torch.ones(7))
    assert weight.shape == (7, 10) and (weight > 0).all()


def test_directions_stay_unit_length():
    torch.testing.assert_close(
        kernel(trained()).expose(pixels()).direction.norm(dim=-1), torch.ones(7, 10)
    )


def test_all_images_start_alike_and_near_the_identity():
    learned = motions()
    motion, weight = learned()
    assert torch.equal(motion[0], motion[2]) and torch.equal(weight[0], weight[2])
    shift = (motion - torch.eye(3, 4)).abs()
    assert (
        0.005 < shift[:, 1:].max() < 0.0185
    )  # biases, up to 0.1 / sqrt(32) before the exponential
    for branch in (learned.rotation, learned.translation):
        *_, head, bias = branch.parameters()
        assert head.abs().max() <= 1e-5 and 0.1 < bias.abs().max() <= 32**-0.5


def test_parameters_are_5280_and_32_for_each_image():
    assert sum(p.numel() for p in motions(29).parameters()) == 5280 + 29 * 32


def published(twist: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation and translation of one twist, as DP-NeRF writes it."""
    r, v = twist[:3], twist[3:]
    theta = r.norm() + 1e-10
    (a, b, c), u = r / theta, v / theta
    w = torch.tensor([[0, -c, b], [c, 0, -a], [-b, a, 0]], dtype=twist.dtype)
    one, sin, cos = torch.eye(3, dtype=twist.dtype), theta.sin(), theta.cos()
    rotation = one + sin * w + (1 - cos) * w @ w
    return rotation, (theta * one + (1 - cos) * w + (theta - sin) * w @ w) @ u


def slow_rays(learned: RigidMotions, code: torch.Tensor, origin, direction):
    """The moved rays of one pixel, outputs taken from the heads one by one."""
    heads = learned.rotation(code[None])[0], learned.translation(code[None])[0]
    for m in range(9):
        twist = torch.stack([0.1 * head[axis * 9 + m] for head in heads for axis in range(3)])
        rotation, shift = published(twist)
        moved = rotation @ origin + shift
        yield moved, rotation @ (origin + direction) + shift - moved


def test_rays_are_those_of_a_loop_over_pixels_and_motions():
    seen, learned = pixels(), trained().double()
    seen = seen.map(lambda x, _: x.double() if x.is_floating_point() else x)
    with torch.no_grad():
        rays = kernel(learned).expose(seen)
        for b in range(len(seen)):
            code = learned.codes.vectors[seen.frame[b]]
            still = rays[b, ORIGIN]
            slow = slow_rays(learned, code, still.origin, still.direction)
            for k, (origin, direction) in enumerate(slow, start=1):
                torch.testing.assert_close(rays.origin[b, k], origin)
                torch.testing.assert_close(rays.direction[b, k], direction)
            weight = learned.weight(code).sigmoid()
            torch.testing.assert_close(rays.weight[b], weight / (weight.sum() + 1e-10))


def test_about_the_camera_a_rotation_leaves_the_origin_where_it_is():
    learned = trained()
    with torch.no_grad():
        for parameter in learned.translation.parameters():
            parameter.zero_()
    about_camera = kernel(learned, "camera").expose(pixels())
    about_world = kernel(learned, "world").expose(pixels())
    assert about_camera.origin.std(1).max() < 1e-6 < about_world.origin.std(1).max()
    assert about_camera.direction.std(1).max() > 0.01


def test_all_pixels_of_an_image_share_their_motions():
    seen = pixels(2)
    seen = replace(seen, frame=torch.tensor([1, 1]), open=seen.open[:1].expand(2))
    seen = replace(seen, close=seen.open + 0.2)
    rays = kernel(trained()).expose(seen)
    torch.testing.assert_close(rays.origin[0], rays.origin[1])
    torch.testing.assert_close(rays.weight[0], rays.weight[1])


def test_gradients_reach_every_parameter():
    seen, learned = pixels(), trained()
    blur = kernel(learned)
    blur.observe(wall(blur.expose(seen)), seen).square().sum().backward()
    for name, parameter in learned.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_gradients_are_finite_at_the_identity():
    learned = motions()
    with torch.no_grad():
        for branch in (learned.rotation, learned.translation):
            list(branch.parameters())[-1].zero_()
    seen, blur = pixels(), kernel(learned)
    blur.observe(wall(blur.expose(seen)), seen).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in learned.parameters())


def test_the_tone_curve_follows_the_sum():
    rgb, weight = torch.rand(7, 10, 3), torch.full((7, 10), 0.1)
    observed = kernel(motions()).observe(lit(rgb, weight), pixels())
    torch.testing.assert_close(observed, gamma(rgb.mean(1)))
