import math

import pytest
import torch

from sharpfield.core.protocols import PointSet
from sharpfield.core.seed import generator
from sharpfield.fields.gaussians.static import Gaussians


def made(count: int = 5, *, sh_degree: int = 2, channels: int = 3) -> Gaussians:
    chance = generator(0, 0, "gaussians")

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=chance)

    harmonics = 0.2 * normal(count, (sh_degree + 1) ** 2, channels)
    return Gaussians(normal(count, 3), normal(count, 4), normal(count, 3), normal(count), harmonics)


def test_at_the_start_they_have_the_colours_they_are_given_from_everywhere():
    colours = torch.rand(4, 3, generator=generator(0, 0, "colours"))
    points = torch.arange(12.0).reshape(4, 3)
    scene = Gaussians.start(points, colours, torch.full((4,), 0.1), sh_degree=3)
    seen = scene.colours(torch.tensor([[0.0, 0.0, -5.0], [9.0, 2.0, 1.0]]))
    torch.testing.assert_close(seen, colours.expand(2, 4, 3))
    torch.testing.assert_close(scene.opacities, torch.full((4,), 0.1))
    torch.testing.assert_close(scene.scales, torch.full((4, 3), 0.1))
    torch.testing.assert_close(scene.rotations, torch.eye(3).expand(4, 3, 3))
    assert torch.equal(scene.means, points) and len(scene) == 4
    assert scene.harmonics.shape == (4, 16, 3)


def test_colours_are_never_negative():
    scene = made()
    scene.base_harmonics.data -= 10
    assert scene.colours(torch.zeros(1, 3)).max() == 0


def test_colour_depends_on_the_direction_alone():
    scene = made()
    near = scene.means.detach()[:1] + torch.tensor([[0.0, 0.6, 0.8]])
    far = scene.means.detach()[:1] + 7 * torch.tensor([[0.0, 0.6, 0.8]])
    torch.testing.assert_close(scene.colours(near)[0, 0], scene.colours(far)[0, 0])


def test_colours_agree_with_a_plain_sum():
    """The basis of degree 2 in its textbook form, one Gaussian at a time."""
    scene, eye = made(), torch.tensor([0.3, -0.2, -4.0])
    for i, mean in enumerate(scene.means.detach()):
        x, y, z = ((mean - eye) / (mean - eye).norm()).tolist()
        basis = [
            math.sqrt(1 / (4 * math.pi)),
            *(math.sqrt(3 / (4 * math.pi)) * v for v in (y, z, x)),
            math.sqrt(15 / (4 * math.pi)) * x * y,
            math.sqrt(15 / (4 * math.pi)) * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
            math.sqrt(15 / (4 * math.pi)) * x * z,
            math.sqrt(15 / (16 * math.pi)) * (x * x - y * y),
        ]
        light = 0.5 + sum(v * scene.harmonics[i, k] for k, v in enumerate(basis))
        torch.testing.assert_close(scene.colours(eye[None])[0, i], light.clamp_min(0))


def test_lower_degrees_leave_out_what_is_above():
    scene, eye = made(sh_degree=2), torch.zeros(1, 3)
    flat = scene.colours(eye, sh_degree=0)
    torch.testing.assert_close(flat[0], (0.5 + 0.28209479 * scene.base_harmonics[:, 0]).clamp(0))
    scene.higher_harmonics.data[:, 3:] = 0
    torch.testing.assert_close(scene.colours(eye, sh_degree=1), scene.colours(eye))


def test_gradients():
    scene = made(3).double()
    names = [name for name, _ in scene.named_parameters()]

    def light(eye: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        changed = dict(zip(names, values, strict=True))
        return torch.func.functional_call(scene, changed, (eye,))

    scene.forward = scene.colours
    eye = torch.tensor([[0.1, 0.2, -3.0]], dtype=torch.float64, requires_grad=True)
    values = [value.detach().clone().requires_grad_() for value in scene.parameters()]
    assert torch.autograd.gradcheck(light, (eye, *values))


def test_they_are_a_point_set():
    scene, other = made(5), made(8)
    assert isinstance(scene, PointSet)
    old = scene.means
    scene.replace(other.points())
    assert scene.means is not old and isinstance(scene.means, torch.nn.Parameter)
    both = scene.parameters(), other.parameters()
    assert all(torch.equal(a, b) for a, b in zip(*both, strict=True))
    assert all(len(rows) == 8 for rows in scene.points().values())


def test_grey_and_none_at_all():
    assert made(channels=1).colours(torch.zeros(2, 3)).shape == (2, 5, 1)
    assert made(0).colours(torch.zeros(2, 3)).shape == (2, 0, 3)


def test_five_harmonics_are_of_no_degree():
    with pytest.raises(ValueError, match="no SH degree has 5 harmonics"):
        Gaussians(
            torch.zeros(1, 3),
            torch.ones(1, 4),
            torch.zeros(1, 3),
            torch.zeros(1),
            torch.zeros(1, 5, 3),
        )
