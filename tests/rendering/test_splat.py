"""Gaussians drawn as views: shapes, backgrounds, parts, and the formula that both engines share."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Radiance, Rays, Views
from sharpfield.core.seed import generator
from sharpfield.core.tone import tone_of
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.formation.mixing import mix
from sharpfield.formation.shutter import Shutter
from sharpfield.geometry import se3
from sharpfield.rendering.splat import Cloud, Splatting, whole
from sharpfield.rendering.view import ViewRenderer, render_view, renderer_of
from tests.formation.toy import pixels

CAMERA = Camera(19, 13, 15.0, 16.0, 9.0, 7.0)
TONE = tone_of("gamma2.2")


def cloud(count: int = 30) -> Gaussians:
    """Before the camera; the colour of each depends on where it is seen from."""
    made = generator(0, 0, "cloud")
    points = torch.randn(count, 3, generator=made) * torch.tensor([1.0, 0.7, 0.4])
    points[:, 2] += 3
    colours = torch.rand(count, 3, generator=made)
    found = Gaussians.start(points, colours, torch.full((count,), 0.15), sh_degree=1, opacity=0.6)
    found.higher_harmonics.data += 0.2 * torch.randn(count, 3, 3, generator=made)
    return found


def splatting(**options) -> Splatting:
    return Splatting(CAMERA, TONE.decode, **options)


def poses(*shape: int) -> Tensor:
    made = generator(0, 0, "poses")
    return se3.exp(0.05 * torch.randn(*shape, 6, generator=made))


def views(pose: Tensor, weight: Tensor | None = None) -> Views:
    """Whole images from poses `[m, k]`."""
    shape = pose.shape[:2]
    time = torch.linspace(0, 1, shape.numel()).reshape(shape)
    corner = torch.zeros(*shape, 2, dtype=torch.int64)
    weight = torch.full(shape, 1 / shape[1]) if weight is None else weight
    return Views(pose, time, weight, corner, CAMERA.size)


class Model:
    """Draws views, and the same rays one by one through a image of each pose."""

    def __init__(self, draw: Splatting, scene: Cloud) -> None:
        self.splatting, self.scene = draw, scene

    def draw_views(self, seen: Views) -> Radiance:
        return self.splatting(self.scene, seen)

    def render(self, rays: Rays) -> Radiance:
        raise AssertionError("not asked for")


def test_views_are_measurements_by_pixels_by_instants():
    weight = torch.tensor([[0.2, 0.3, 0.5], [1.0, 0.0, -1.0]])
    seen = splatting()(cloud(), views(poses(2, 3), weight))
    assert seen.shape == (2, 13, 19, 3) and seen.rgb.shape == (2, 13, 19, 3, 3)
    assert torch.equal(seen.weight, weight[:, None, None].expand(2, 13, 19, 3))
    assert seen.opacity.min() >= 0 and seen.opacity.max() < 1


def test_each_view_is_what_it_is_alone():
    pose = poses(2, 3)
    together = splatting()(cloud(), views(pose))
    for m in range(2):
        for k in range(3):
            alone = splatting()(cloud(), views(pose[m : m + 1, k : k + 1]))
            for name in ("rgb", "depth", "opacity"):
                found, wanted = (getattr(x, name) for x in (together[m, ..., k], alone[0, ..., 0]))
                torch.testing.assert_close(found, wanted, msg=name)


def test_one_opaque_wall_shows_its_colour_as_light_at_its_depth():
    colour = torch.tensor([[0.2, 0.5, 0.9]])
    wall = Gaussians.start(torch.tensor([[0.0, 0.0, 4.0]]), colour, torch.ones(1), opacity=0.9999)
    wall.log_scales.data = torch.tensor([[50.0, 50.0, 1e-3]]).log()
    seen = splatting()(wall, views(torch.eye(3, 4)[None, None]))
    torch.testing.assert_close(
        seen.rgb, TONE.decode(colour).expand(seen.rgb.shape), atol=2e-3, rtol=0
    )
    torch.testing.assert_close(seen.depth, torch.full(seen.shape, 4.0), rtol=1e-5, atol=0)


@pytest.mark.parametrize("background", [0.0, 0.4, 1.0])
def test_background_is_seen_through_what_is_not_opaque(background: float):
    scene = cloud()
    plain, before = (
        splatting(**options)(scene, views(poses(1, 1))) for options in ({}, {"background": 0.4})
    )
    torch.testing.assert_close(before.rgb, plain.rgb + 0.4 * (1 - plain.opacity[..., None]))
    none = Gaussians.start(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    empty = splatting(background=background)(none, views(poses(1, 1)))
    assert (empty.rgb == background).all() and not empty.opacity.any() and not empty.depth.any()


@pytest.mark.parametrize("antialiased", [True, False])
def test_a_whole_image_is_its_parts(antialiased: bool):
    draw, scene, pose = splatting(antialiased=antialiased, background=0.3), cloud(), poses(1, 1)
    seen = draw(scene, views(pose))
    for left, top, width, height in ((0, 0, 7, 13), (7, 0, 12, 5), (7, 5, 12, 8)):
        corner = torch.tensor([left, top]).expand(1, 1, 2)
        part = draw(scene, replace(views(pose), corner=corner, size=(width, height)))
        wanted = seen[:, top : top + height, left : left + width]
        for name in ("rgb", "depth", "opacity"):
            found = getattr(part, name)
            torch.testing.assert_close(found, getattr(wanted, name), atol=2e-6, rtol=1e-5, msg=name)


def test_thin_splats_are_fainter_when_antialiased():
    thin = cloud()
    thin.log_scales.data -= 4
    smooth, classic = (
        splatting(antialiased=how)(thin, views(poses(1, 1))).opacity.mean() for how in (True, False)
    )
    assert smooth < 0.5 * classic


def test_a_blurred_frame_is_the_mean_of_its_views():
    """The formula of `formation.mixing`, by hand."""
    scene, pose = cloud(), poses(2, 5)
    blurred = mix(splatting()(scene, views(pose)), outer=TONE.encode)
    for m in range(2):
        each = [
            render_view(Model(splatting(), scene), CAMERA, pose[m, k], 0.0).rgb for k in range(5)
        ]
        torch.testing.assert_close(blurred[m], TONE.encode(torch.stack(each).mean(0)))


class Swing:
    """A trajectory from one pose to another."""

    def pose(self, time: Tensor, track: Tensor) -> Tensor:
        twist = torch.tensor([0.02, -0.05, 0.01, 0.2, 0.1, 0.05])
        return se3.exp(time[..., None] * twist)

    def known_us(self, track: int) -> None:
        return None


def test_both_engines_report_the_same_blur():
    """Rays through `Shutter`, looked up in images of each instant; and views, through `mix`."""
    scene, draw, instants = cloud(), splatting(), 4
    shutter = Shutter(CAMERA, Swing(), instants, TONE.encode)
    seen = replace(pixels(9), open=torch.full((9,), 0.2), close=torch.full((9,), 0.8))
    xy = torch.stack([torch.arange(9) * 2 + 0.5, torch.arange(9) + 2.5], -1)
    rays = shutter.expose(replace(seen, xy=xy))

    pose = Swing().pose(rays.time[:1], torch.zeros(1, instants, dtype=torch.int64))
    images = draw(scene, views(pose, rays.weight[:1]))
    found = mix(images, outer=TONE.encode)[0]

    def looked_up(rays: Rays) -> Radiance:
        """What a renderer of rays would see: each ray in the image of its own instant."""
        inside = se3.rotate(se3.inverse(pose.expand(9, instants, 3, 4)), rays.direction)
        x, y = CAMERA.project(inside).floor().long().unbind(-1)
        k = torch.arange(instants).expand(9, instants)
        return replace(images[0, y, x, k], weight=rays.weight)

    torch.testing.assert_close(rays.origin, pose[:, :, :, 3].expand(9, instants, 3))
    wanted = shutter.observe(looked_up(rays), seen)
    x, y = xy.floor().long().unbind(-1)
    torch.testing.assert_close(found[y, x], wanted)


def test_events_between_views_change_sign_when_turned_round_and_add_up():
    scene, pose = cloud(), poses(1, 3)

    def change(first: int, second: int) -> Tensor:
        ends = views(pose[:, [first, second]], torch.tensor([[-1.0, 1.0]]))
        return mix(splatting(background=0.2)(scene, ends), inner=torch.log)

    torch.testing.assert_close(change(0, 2), -change(2, 0))
    torch.testing.assert_close(change(0, 1) + change(1, 2), change(0, 2), atol=1e-5, rtol=1e-5)
    assert change(0, 2).abs().max() > 0.05


def test_a_model_that_draws_views_is_asked_for_the_whole_view():
    model, pose = Model(splatting(background=0.1), cloud()), poses(1, 1)
    assert isinstance(model, ViewRenderer) and renderer_of(model) is model
    assert isinstance(cloud(), Cloud)
    said: list[tuple[int, int]] = []
    seen = render_view(
        renderer_of(model), CAMERA, pose[0, 0], 0.5, progress=lambda *d: said.append(d)
    )
    wanted = model.draw_views(views(pose))[0, ..., 0]
    assert seen.shape == (13, 19) and said == [(247, 247)] and not seen.rgb.requires_grad
    torch.testing.assert_close(seen.rgb, wanted.rgb)
    one = whole(CAMERA, pose[0, 0], 0.5)
    assert one.shape == (1, 1) and one.time == 0.5 and one.weight == 1 and not one.corner.any()


def test_everything_learns_from_a_blurred_frame():
    scene, pose = cloud(), poses(1, 3).requires_grad_()
    mix(splatting()(scene, views(pose)), outer=TONE.encode).square().sum().backward()
    assert pose.grad is not None and pose.grad.abs().amax((2, 3)).min() > 0
    for name, parameter in scene.named_parameters():
        assert parameter.grad is not None and parameter.grad.any(), name


def test_shifts_tell_how_splats_wish_to_move():
    scene, pose = cloud(), poses(1, 2)
    shift = torch.zeros(2, 30, 2, requires_grad=True)
    splatting()(scene, views(pose), shift).rgb.square().sum().backward()
    assert shift.grad is not None and shift.grad.abs().sum((1, 2)).min() > 0
    aside = splatting()(scene, views(pose), torch.tensor([3.0, 0.0]).expand(2, 30, 2))
    moved = splatting()(scene, views(pose))
    torch.testing.assert_close(aside.rgb[:, :, 3:], moved.rgb[:, :, :-3], atol=1e-5, rtol=1e-5)
