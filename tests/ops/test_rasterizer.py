"""Gaussians on a canvas: laws, edge cases, gradients; compiled tiles against the definition."""

import dataclasses

import pytest
import torch
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.ops._dispatch import using
from sharpfield.ops.rasterizer import FAINTEST, MOST, Canvas, Drawn, rasterize

WIDTH, HEIGHT = 37, 21
"""Neither a multiple of a tile, so that borders are tested too."""

CAMERA = Camera(WIDTH, HEIGHT, 30.0, 32.0, 18.0, 11.0)


Scene = list[Tensor]


def canvas(views: int = 1, *, antialiased: bool = True) -> Canvas:
    corner = torch.zeros(views, 2, dtype=torch.int64)
    return Canvas(CAMERA, corner, (WIDTH, HEIGHT), antialiased)


def scene(count: int, seed: int = 0) -> list[Tensor]:
    """Means, quaternions, scales, opacities, colours and one pose; float64."""
    made = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=made, dtype=torch.float64)

    means = (uniform(count, 3) - 0.5) * torch.tensor([3.0, 2.0, 1.0])
    means[:, 2] += 2.5
    return [
        means,
        uniform(count, 4) - 0.5,
        uniform(count, 3) * 0.2 + 0.01,
        uniform(count) * 0.9,
        uniform(1, count, 3),
        torch.eye(3, 4, dtype=torch.float64)[None],
    ]


def single(
    x: float, y: float, z: float, *, scale: float = 0.1, opacity: float = 0.5
) -> list[Tensor]:
    return [
        torch.tensor([[x, y, z]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), scale),
        torch.tensor([opacity]),
        torch.ones(1, 1, 3),
        torch.eye(3, 4)[None],
    ]


def both(arguments: list[Tensor], where: Canvas) -> list[tuple[Tensor, Tensor]]:
    """Values and gradients of the compiled version in float32 and of the definition in float64."""
    found = []
    for choice, dtype in (("fast", torch.float32), ("reference", torch.float64)):
        leaves = [a.detach().to(dtype).requires_grad_() for a in arguments]
        with using(choice):
            drawn = rasterize(*leaves, where)
        made = torch.Generator().manual_seed(1)
        weights = [torch.randn(image.shape, generator=made).to(dtype) for image in drawn]
        loss = torch.stack([(i * w).sum() for i, w in zip(drawn, weights, strict=True)]).sum()
        found.append([*drawn, *torch.autograd.grad(loss, leaves)])
    return list(zip(*found, strict=True))


def giant_and_tiny() -> list[Tensor]:
    arguments = scene(60)
    arguments[2][0] = 3.0
    arguments[2][1:] = 2e-3
    return arguments


def partly_behind() -> list[Tensor]:
    arguments = scene(40)
    arguments[0][::2, 2] *= -1
    arguments[0][1, 2] = 1e-4
    return arguments


def at_the_border() -> list[Tensor]:
    arguments = scene(40)
    arguments[0][:, 0] = torch.where(arguments[0][:, 0] > 0, 1.5, -1.5)
    return arguments


def with_transparent() -> list[Tensor]:
    arguments = scene(40)
    arguments[3][::3] = 0.0
    return arguments


def opaque() -> list[Tensor]:
    arguments = scene(300)
    arguments[3][:] = 0.9999
    return arguments


def far_aside() -> list[Tensor]:
    arguments = scene(20)
    arguments[0][:, 0] += 4
    arguments[2][:] = 1.0
    return arguments


SCENES = [giant_and_tiny, partly_behind, at_the_border, with_transparent, opaque, far_aside]


@pytest.mark.parametrize("antialiased", [True, False], ids=["antialiased", "classic"])
@pytest.mark.parametrize("make", SCENES, ids=lambda make: make.__name__)
def test_tiles_agree_with_the_definition(make, antialiased: bool) -> None:
    compared = both(make(), canvas(antialiased=antialiased))
    for tiles, definition in compared[:3]:
        assert float((tiles - definition).detach().abs().max()) <= 1e-4
    largest = max(float(definition.abs().max()) for _, definition in compared[3:])
    for tiles, definition in compared[3:]:
        # Round Gaussians do not care how they are turned: that gradient is rounding alone.
        floor = 1e-5 * largest
        error = float((tiles - definition).abs().max())
        assert error <= max(1e-3 * float(definition.abs().max()), floor)


def test_nothing_visible_is_black_and_wants_nothing() -> None:
    arguments = scene(10)
    arguments[0][:, 2] -= 10
    for tiles, definition in both(arguments, canvas()):
        assert (tiles == 0).all() and (definition == 0).all()


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_no_gaussians_at_all(choice: str) -> None:
    some = single(0.0, 0.0, 2.0)
    arguments = [*(a[:0] for a in some[:4]), some[4][:, :0], some[5]]
    with using(choice):
        drawn = rasterize(*arguments, canvas())
    assert drawn.light.shape == (1, HEIGHT, WIDTH, 3)
    assert (drawn.opacity == 0).all()


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_a_splat_lies_where_the_camera_sees_its_mean(choice: str) -> None:
    x, y = 0.3, -0.2
    with using(choice):
        drawn = rasterize(*single(x, y, 2.0, scale=0.02), canvas())
    row, column = divmod(int(drawn.opacity[0].argmax()), WIDTH)
    seen = CAMERA.project(torch.tensor([x, y, 2.0]))
    assert (column + 0.5 - seen[0]).abs() <= 0.5 and (row + 0.5 - seen[1]).abs() <= 0.5


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_a_large_splat_stops_its_opacity_at_its_centre(choice: str) -> None:
    with using(choice):
        drawn = rasterize(*single(0, 0, 2.0, scale=1.0, opacity=0.7), canvas())
    peak = float(drawn.opacity.max())
    assert peak == pytest.approx(0.7, abs=2e-3)
    depth = drawn.depth / drawn.opacity
    assert float(depth[0, 11, 18]) == pytest.approx(2.0, abs=1e-5)


def test_none_stops_all_light() -> None:
    drawn = rasterize(*single(0, 0, 2.0, scale=100.0, opacity=1.0), canvas())
    assert float(drawn.opacity.max()) == pytest.approx(MOST, abs=1e-6)


def test_antialiasing_keeps_the_light_of_thin_splats() -> None:
    """A splat much thinner than a pixel sends as much light as its size, not as the widening."""
    total = {}
    for antialiased in (True, False):
        drawn = rasterize(*single(0, 0, 2.0, scale=0.01), canvas(antialiased=antialiased))
        total[antialiased] = float(drawn.opacity.sum())
    assert total[True] < 0.3 * total[False]


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_the_nearer_one_hides_the_farther_one_whatever_their_order(choice: str) -> None:
    near, far = single(0, 0, 1.5, scale=1.0, opacity=1.0), single(0, 0, 3.0, scale=2.0, opacity=1.0)
    far[4] = torch.zeros(1, 1, 3)
    images = []
    for one, other in ((near, far), (far, near)):
        arguments = [torch.cat([a, b]) for a, b in zip(one[:4], other[:4], strict=True)]
        colours = torch.cat([one[4], other[4]], 1)
        with using(choice):
            images.append(rasterize(*arguments, colours, near[5], canvas()).light)
    assert torch.equal(images[0], images[1])
    assert float(images[0][0, 11, 18, 0]) == pytest.approx(MOST, abs=1e-3)


@pytest.mark.parametrize("choice", ["reference", "fast"])
def test_a_part_of_the_image_is_that_part(choice: str) -> None:
    arguments = [a.float() for a in scene(50)]
    part = Canvas(CAMERA, torch.tensor([[7, 3]]), (17, 9))
    with using(choice):
        whole, cut = rasterize(*arguments, canvas()), rasterize(*arguments, part)
    for image, piece in zip(whole, cut, strict=True):
        torch.testing.assert_close(image[:, 3:12, 7:24], piece, atol=2e-5, rtol=1e-4)


def test_several_views_are_each_as_if_alone() -> None:
    arguments = [a.float() for a in scene(50)]
    poses = torch.eye(3, 4).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 0.2, -0.1])
    colours = torch.rand(3, 50, 3, generator=torch.Generator().manual_seed(3))
    together = rasterize(*arguments[:4], colours, poses, canvas(3))
    for view in range(3):
        one = slice(view, view + 1)
        alone = rasterize(*arguments[:4], colours[one], poses[one], canvas())
        for image, single_image in zip(together, alone, strict=True):
            assert torch.equal(image[one], single_image)


def test_the_pose_gradient_is_that_of_finite_differences() -> None:
    arguments = scene(25)
    weights = torch.randn(1, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(5)).double()

    def loss(pose: Tensor) -> Tensor:
        with using("reference"):
            return (rasterize(*arguments[:5], pose, canvas()).light * weights).sum()

    pose = arguments[5].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(pose), pose)
    fast = [a.float().requires_grad_() for a in arguments]
    with using("fast"):
        drawn = rasterize(*fast, canvas())
    (compiled,) = torch.autograd.grad((drawn.light * weights.float()).sum(), fast[5])
    step = 1e-6
    for i in range(3):
        for j in range(4):
            moved = torch.zeros(1, 3, 4, dtype=torch.float64)
            moved[0, i, j] = step
            slope = (loss(pose.detach() + moved) - loss(pose.detach() - moved)) / (2 * step)
            largest = float(gradient.abs().max())
            assert float(gradient[0, i, j]) == pytest.approx(float(slope), abs=1e-4 * largest)
            assert float(compiled[0, i, j]) == pytest.approx(float(slope), abs=1e-3 * largest)


def test_a_shift_moves_splats_and_learns() -> None:
    arguments = [a.float() for a in scene(30)]
    still = rasterize(*arguments, canvas()).light
    right = rasterize(*arguments, canvas(), torch.tensor([1.0, 0.0]).expand(1, 30, 2)).light
    torch.testing.assert_close(right[:, :, 1:], still[:, :, :-1], atol=1e-4, rtol=1e-3)
    gradients = []
    for choice in ("reference", "fast"):
        shift = torch.zeros(1, 30, 2, requires_grad=True)
        with using(choice):
            drawn: Drawn = rasterize(*arguments, canvas(), shift)
        gradients.append(torch.autograd.grad(drawn.light.square().sum(), shift)[0])
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-3)


def test_what_is_too_faint_is_left_out() -> None:
    drawn = rasterize(*single(0, 0, 2.0, scale=1.0, opacity=0.9 * FAINTEST), canvas())
    assert (drawn.opacity == 0).all()


def test_lenses_with_distortion_are_refused() -> None:
    bent = dataclasses.replace(CAMERA, lens="brown", distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(AssertionError, match="without distortion"):
        Canvas(bent, torch.zeros(1, 2, dtype=torch.int64), (WIDTH, HEIGHT))
