"""Gaussians seen through lenses that bend straight lines."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.errors import OptionError
from sharpfield.core.tone import tone_of
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry import se3
from sharpfield.ops.rasterizer import Drawn
from sharpfield.rendering.splat import STEEPEST, Splatting, flattened, resampled, whole

IDEAL = Camera(60, 44, 40.0, 42.0, 31.0, 21.0)
BARREL = replace(IDEAL, lens="brown", distortion=(-0.3, 0.08, 0.004, -0.003, 0.0))
CUSHION = replace(IDEAL, lens="brown", distortion=(0.25, 0.05, 0.0, 0.0, 0.0))
FISH = replace(IDEAL, lens="fisheye", distortion=(-0.02, 0.005, 0.0, 0.0))
SQUARE = replace(IDEAL, fy_px=IDEAL.fx_px)
LENSES = {"barrel": BARREL, "cushion": CUSHION, "fisheye": FISH}
TONE = tone_of("gamma2.2")


def dots(points: Tensor, size: float = 0.05) -> Gaussians:
    """Small opaque white Gaussians."""
    count = len(points)
    return Gaussians.start(points, torch.ones(count, 3), torch.full((count,), size), opacity=0.9)


def draw(camera: Camera, cloud: Gaussians, pose: Tensor | None = None, **options):
    splatting = Splatting(camera, TONE.decode, **options)
    return splatting(cloud, whole(camera, torch.eye(3, 4) if pose is None else pose, 0.0))[0]


def middle_of(light: Tensor, camera: Camera) -> Tensor:
    """Where a dot lies, in pixels."""
    return (camera.grid() * light[..., None]).sum((0, 1)) / light.sum()


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("xy", [(31.0, 21.0), (8.0, 7.0), (52.0, 36.0), (50.0, 8.0)])
def test_a_dot_is_where_the_lens_shows_it(lens: str, xy: tuple[float, float]):
    camera = LENSES[lens]
    point = 3 * camera.direction(torch.tensor([xy]))
    seen = draw(camera, dots(point))
    found = middle_of(seen.rgb[..., 0, 1], camera)
    torch.testing.assert_close(found, torch.tensor(xy), atol=0.1, rtol=0)


@pytest.mark.parametrize("lens", LENSES)
def test_a_wall_has_its_own_depth_and_light_everywhere(lens: str):
    """No pixel looks past the edge of the flat image, and depth stays that along the axis."""
    camera, colour = LENSES[lens], torch.tensor([[0.2, 0.5, 0.9]])
    wall = Gaussians.start(torch.tensor([[0.0, 0.0, 4.0]]), colour, torch.ones(1), opacity=0.9999)
    wall.log_scales.data = torch.tensor([[200.0, 200.0, 1e-3]]).log()
    seen = draw(camera, wall)
    light = TONE.decode(colour).expand(44, 60, 3)
    torch.testing.assert_close(seen.rgb[..., 0, :], light, atol=3e-3, rtol=0)
    torch.testing.assert_close(seen.depth[..., 0], torch.full((44, 60), 4.0), rtol=1e-4, atol=0)


def test_a_lens_that_bends_nothing_changes_next_to_nothing():
    made = torch.Generator().manual_seed(0)
    points = torch.randn(40, 3, generator=made) * torch.tensor([1.0, 0.7, 0.3])
    cloud = dots(points + torch.tensor([0.0, 0.0, 3.0]), 0.2)
    straight = draw(SQUARE, cloud).rgb
    bent = draw(replace(SQUARE, lens="brown", distortion=(0.0,) * 5), cloud).rgb
    assert (straight - bent).abs().max() < 1e-4


def test_it_is_like_a_fine_image_looked_up_ray_by_ray():
    """Oracle: a pinhole image of eight times as many pixels, at the nearest of them."""
    made = torch.Generator().manual_seed(1)
    points = torch.randn(60, 3, generator=made) * torch.tensor([1.2, 0.9, 0.3])
    cloud = dots(points + torch.tensor([0.0, 0.0, 3.0]), 0.25)
    for camera in LENSES.values():
        fine = Camera(1600, 1200, 320.0, 320.0, 800.0, 600.0)
        ray = camera.direction(camera.grid())
        x, y = fine.project(ray).floor().long().unbind(-1)
        wanted = draw(fine, cloud, antialiased=False).rgb[y, x, 0]
        found = draw(camera, cloud, antialiased=False).rgb[..., 0, :]
        assert (found - wanted).abs().mean() < 0.01 and (found - wanted).abs().max() < 0.12


@pytest.mark.parametrize("lens", LENSES)
def test_a_whole_image_is_its_parts(lens: str):
    camera, cloud = LENSES[lens], dots(torch.tensor([[0.2, 0.1, 2.0], [-0.6, -0.3, 2.5]]), 0.3)
    splatting, view = Splatting(camera, TONE.decode), whole(camera, torch.eye(3, 4), 0.0)
    seen = splatting(cloud, view)
    for left, top, width, height in ((0, 0, 20, 44), (20, 0, 40, 17), (20, 17, 40, 27)):
        corner = torch.tensor([left, top]).expand(1, 1, 2)
        part = splatting(cloud, replace(view, corner=corner, size=(width, height)))
        wanted = seen[:, top : top + height, left : left + width]
        torch.testing.assert_close(part.rgb, wanted.rgb, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(part.depth, wanted.depth, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("lens", LENSES)
def test_the_flat_image_is_as_fine_as_the_lens(lens: str):
    """Neighbouring pixels are at least a flat pixel apart, or about, and all lie inside."""
    flat = flattened(LENSES[lens])
    where = flat.where
    apart = (where[:, 1:] - where[:, :-1]).norm(dim=-1)
    assert apart.min() > 0.98 and apart.max() < 3
    assert where.min() > 1 and (where < torch.tensor(flat.camera.size) - 1).all()
    assert flattened(LENSES[lens]) is flat


def test_where_a_lens_sees_very_wide_images_are_coarser():
    wide = Camera(60, 44, 28.0, 28.0, 30.0, 22.0, "fisheye", (0.0, 0.0, 0.0, 0.0))
    flat = flattened(wide).camera
    assert flat.fx_px < wide.fx_px and flat.width * flat.height < 4.4 * 60 * 44


def test_a_lens_that_sees_behind_itself_is_refused():
    fish = Camera(60, 44, 18.0, 18.0, 30.0, 22.0, "fisheye", (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(OptionError, match="field of view is too wide") as refused:
        flattened(fish)
    assert "116 degrees from the optical axis" in str(refused.value)
    assert torch.rad2deg(torch.tensor(STEEPEST).atan()) > 75


def test_everything_learns_through_a_lens():
    cloud, pose = dots(torch.tensor([[0.3, 0.2, 2.0], [-0.6, 0.1, 2.5]]), 0.2), torch.eye(3, 4)
    pose.requires_grad_()
    draw(BARREL, cloud, pose).rgb.square().sum().backward()
    assert pose.grad is not None and pose.grad.abs().min(1).values.max() > 0
    for name in ("means", "log_scales", "opacity_logits", "base_harmonics"):
        assert getattr(cloud, name).grad.any(), name


def test_a_pose_learned_through_a_lens_goes_the_right_way():
    """The slope agrees with finite differences of the whole image."""
    cloud = dots(torch.tensor([[0.5, 0.3, 2.0], [-0.6, 0.1, 2.5]]), 0.4)
    target = draw(FISH, cloud).rgb.detach()

    def error(twist: Tensor) -> Tensor:
        return (draw(FISH, cloud, se3.exp(twist)).rgb - target).square().sum()

    start = torch.tensor([0.01, -0.02, 0.015, 0.02, 0.03, -0.02], requires_grad=True)
    slope = torch.autograd.grad(error(start), start)[0]
    for axis in range(6):
        step = torch.zeros(6)
        step[axis] = 2e-3
        with torch.no_grad():
            wanted = (error(start + step) - error(start - step)) / 4e-3
        torch.testing.assert_close(slope[axis], wanted, rtol=0.02, atol=0.02 * float(slope.norm()))


def test_looking_up_is_exact_for_planes_and_differentiable():
    """Bilinear interpolation leaves linear images as they are."""
    y, x = torch.meshgrid(torch.arange(5.0) + 0.5, torch.arange(7.0) + 0.5, indexing="ij")
    plane = (2 * x + 3 * y)[None].double().requires_grad_()
    drawn = Drawn(plane[..., None], -plane, plane / 100)
    where = torch.tensor([[[[1.2, 3.4], [5.9, 0.6]]]], dtype=torch.float64)
    seen = resampled(drawn, where)
    wanted = torch.tensor([[[2 * 1.2 + 3 * 3.4, 2 * 5.9 + 3 * 0.6]]], dtype=torch.float64)
    torch.testing.assert_close(seen.light[..., 0], wanted)
    torch.testing.assert_close(seen.depth, -wanted)
    torch.testing.assert_close(seen.opacity, wanted / 100)
    assert torch.autograd.gradcheck(
        lambda plane: resampled(Drawn(plane[..., None], plane, plane), where), (plane,)
    )
