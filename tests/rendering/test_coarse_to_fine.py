"""Rendering of scenes whose light is known in closed form."""

import math

import pytest
import torch
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.seed import generator
from sharpfield.geometry.rays import cast
from sharpfield.geometry.space import EvenDepth, Frustum
from sharpfield.rendering.coarse_to_fine import CoarseToFine, Compositing

CAMERA = Camera(8, 6, 9.0, 9.0, 4.0, 3.0)
DENSITY, BEGIN, END = 2.0, 1.5, 2.2
OPEN = Compositing(opaque_end=False, background=0.25)


class SlabHead(nn.Module):
    """Fog of one colour between two depths."""

    def __init__(self, colour: tuple[float, float, float], begin: float, end: float) -> None:
        super().__init__()
        self.density_inside = nn.Parameter(torch.tensor(DENSITY))
        self.light = nn.Parameter(torch.tensor(colour))
        self.begin, self.end = begin, end

    def density(self, features: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        inside = (points[..., 2] > self.begin) & (points[..., 2] < self.end)
        return self.density_inside * inside, points

    def feature(self, hidden: Tensor) -> Tensor:
        return hidden

    def colour(self, feature: Tensor, direction: Tensor) -> Tensor:
        return self.light.expand(*feature.shape[:-1], 3)


class Slab(nn.Module):
    """The same fog for both stages, in other colours."""

    def __init__(self, begin: float = BEGIN, end: float = END) -> None:
        super().__init__()
        self.coarse = SlabHead((1.0, 0.0, 0.0), begin, end)
        self.fine = SlabHead((0.2, 0.5, 0.8), begin, end)

    def coarse_features(self, points: Tensor, time: Tensor) -> Tensor:
        return points[..., :0]

    def fine_features(self, features: Tensor, old: Tensor, new: Tensor, time: Tensor) -> Tensor:
        return torch.cat([old, new], -2)[..., :0]


def rays(*shape: int) -> Rays:
    """From the origin through pixels everywhere."""
    made = generator(0, 0, "rays")
    xy = torch.rand(*shape, 2, generator=made) * torch.tensor([8.0, 6.0])
    ones = torch.ones(shape)
    return cast(CAMERA, torch.eye(3, 4).expand(*shape, 3, 4), xy, ones, 2 * ones)


def renderer(samples: tuple[int, int] = (64, 64), **change) -> CoarseToFine:
    return CoarseToFine(Slab(), EvenDepth(CAMERA, 0.5, 4.0), samples, how=OPEN, **change)


def closed_form(rays: Rays) -> tuple[Tensor, Tensor]:
    """Opacity and depth (not divided by it) of the fog along each ray."""
    slope = rays.direction[..., 2]
    first, length = BEGIN / slope, (END - BEGIN) / slope
    passed = torch.exp(-DENSITY * length)
    return 1 - passed, first * (1 - passed) + 1 / DENSITY - passed * (length + 1 / DENSITY)


def errors(found: Radiance, rays: Rays) -> list[float]:
    """Largest error of colour, opacity and depth."""
    opacity, depth = closed_form(rays)
    colour = torch.tensor([0.2, 0.5, 0.8]) * opacity[..., None] + 0.25 * (1 - opacity[..., None])
    pairs = [(found.rgb, colour), (found.opacity, opacity), (found.depth, depth)]
    return [(one - other).abs().max().item() for one, other in pairs]


@torch.no_grad()
def test_fog_is_seen_as_it_is():
    seen = rays(12)
    rough, fine = (errors(renderer((n, n))(seen), seen) for n in (32, 512))
    assert max(fine[:2]) < 0.01 and fine[2] < 0.02
    assert all(8 * small < large for small, large in zip(fine, rough, strict=True))


@torch.no_grad()
def test_jitter_is_right_on_average():
    seen = rays(2).reshape(2, 1)[:, [0] * 200]
    found = renderer((32, 32), noise=0.0)(seen, generator(0, 0, "samples"))
    opacity, _ = closed_form(seen)
    mean = found.opacity.mean(1)
    assert found.opacity.std(1).min() > 1e-3
    torch.testing.assert_close(mean, opacity[:, 0], rtol=0, atol=0.02)


@torch.no_grad()
def test_a_wall_in_a_frustum():
    """A wall at depth 2 is half way in normalised device coordinates, and ends every ray."""
    wall = Slab(begin=0.0, end=9.0)  # in NDC, -1...1 runs from depth 1 to infinity
    wall.fine.density_inside.fill_(1e6)
    wall.coarse.density_inside.fill_(1e6)
    space = Frustum(CAMERA)
    found = CoarseToFine(wall, space, (64, 64))(rays(40))
    torch.testing.assert_close(found.opacity, torch.ones(40))
    torch.testing.assert_close(space.depth(found.depth), torch.full((40,), 2.0), rtol=0, atol=0.03)
    torch.testing.assert_close(found.rgb, torch.tensor([0.2, 0.5, 0.8]).expand(40, 3))


@torch.no_grad()
def test_fine_points_go_where_the_light_is():
    found = renderer()(rays(40), samples=True)
    assert found.samples is not None
    depth = found.samples.depth
    assert depth.shape == (40, 128) and (depth.diff(dim=-1) >= 0).all()
    z = depth * rays(40).direction[:, None, 2]
    inside = ((z > BEGIN - 0.1) & (z < END + 0.1)).float().sum(-1)
    assert (inside > 64).all()  # evenly spread they would be a quarter of 128


@torch.no_grad()
def test_both_stages_are_reported():
    found = renderer()(rays(5))
    assert found.coarse is not None and found.samples is None
    share = found.coarse.opacity[:, None]
    wanted = torch.tensor([1.0, 0, 0]) * share + 0.25 * (1 - share)
    torch.testing.assert_close(found.coarse.rgb, wanted)


@torch.no_grad()
def test_without_a_generator_a_ray_always_sees_the_same():
    seen, view = rays(4, 3), renderer(noise=1.0)
    first, second = view(seen), view(seen)
    assert torch.equal(first.rgb, second.rgb)
    torch.testing.assert_close(view(seen[1:2, ::2]).rgb, first.rgb[1:2, ::2])


@torch.no_grad()
def test_with_a_generator_its_seed_decides():
    seen, view = rays(40), renderer()
    first, same, other = (view(seen, generator(seed, 0, "samples")) for seed in (1, 1, 2))
    assert torch.equal(first.rgb, same.rgb) and torch.equal(first.depth, same.depth)
    assert not torch.equal(first.depth, other.depth)


@torch.no_grad()
def test_noise_is_only_for_training():
    view, seen = renderer(noise=50.0), rays(40)
    torch.testing.assert_close(view(seen).rgb, renderer(noise=0.0)(seen).rgb)
    noisy, quiet = (
        CoarseToFine(Slab(), EvenDepth(CAMERA, 0.5, 4.0), noise=noise, how=OPEN)(
            seen, generator(0, 0, "samples")
        )
        for noise in (50.0, 0.0)
    )
    assert (noisy.opacity - quiet.opacity).abs().max() > 0.1


@torch.no_grad()
@pytest.mark.parametrize("shape", [(), (7,), (4, 3), (0,), (2, 0)])
def test_rays_of_any_shape(shape: tuple[int, ...]):
    found = renderer((8, 8))(rays(*shape))
    assert found.rgb.shape == (*shape, 3) and found.depth.shape == shape
    assert (found.weight == 2).all()


def test_density_learns_the_closed_form_gradient():
    """d opacity / d density = length exp(-density length)."""
    view = renderer((256, 256))
    seen = rays(1)
    view(seen).opacity.sum().backward()
    length = (END - BEGIN) / seen.direction[0, 2].item()
    grad = view.field.fine.density_inside.grad
    assert grad.item() == pytest.approx(length * math.exp(-DENSITY * length), rel=0.02)
    assert view.field.coarse.density_inside.grad is None, "where to look does not learn"


def test_everything_learns():
    view = renderer()
    found = view(rays(6), generator(0, 0, "samples"))
    (found.rgb.sum() + found.coarse.rgb.sum()).backward()
    assert all(p.grad is not None and p.grad.any() for p in view.field.parameters())
