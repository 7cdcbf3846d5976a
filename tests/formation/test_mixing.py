import torch

from sharpfield.core.tone import identity
from sharpfield.formation.mixing import mix, mix_with_few_gradients
from tests.formation.toy import lit


def test_weights_of_one_ray_pass_its_light():
    rgb = torch.rand(5, 1, 3)
    assert torch.equal(mix(lit(rgb, torch.ones(5, 1))), rgb[:, 0])


def test_it_is_the_formula_written_as_a_loop():
    rgb, weight = torch.rand(4, 6, 3), torch.rand(4, 6)
    mixed = mix(lit(rgb, weight), inner=torch.square, outer=torch.sqrt)
    for b in range(4):
        total = sum(weight[b, k] * rgb[b, k] ** 2 for k in range(6))
        torch.testing.assert_close(mixed[b], total.sqrt())


def test_whole_images_mix_like_scattered_pixels():
    rgb, weight = torch.rand(3, 2, 5, 3), torch.rand(3, 2, 5)
    image = mix(lit(rgb, weight))
    scattered = mix(lit(rgb.flatten(0, 1), weight.flatten(0, 1)))
    assert torch.equal(image.flatten(0, 1), scattered)


def test_inner_may_reduce_channels():
    rgb = torch.rand(4, 2, 3)
    assert mix(lit(rgb, torch.ones(4, 2)), inner=lambda x: x.sum(-1, keepdim=True)).shape == (4, 1)


def test_gradients():
    rgb = torch.rand(2, 3, 1, dtype=torch.float64, requires_grad=True)
    weight = torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, w: mix(lit(x, w), inner=torch.exp), (rgb, weight))


def test_of_many_rays_a_few_give_the_gradient():
    """Six rays that count alike, of which two learn."""
    rgb = torch.rand(4, 6, 3, dtype=torch.float64, requires_grad=True)
    few, rest = (
        lit(rgb[:, :2], torch.full((4, 2), 1 / 2)),
        lit(rgb[:, 2:], torch.full((4, 4), 1 / 6)),
    )
    mean = mix_with_few_gradients(few, rest)
    torch.testing.assert_close(mean, rgb.mean(1))
    mean.square().sum().backward()
    pull = 2 * mean.detach()[:, None] / 2
    torch.testing.assert_close(rgb.grad[:, :2], pull.expand(4, 2, 3))
    assert not rgb.grad[:, 2:].any()


def test_no_measurements_give_none():
    assert mix(lit(torch.zeros(0, 4, 3), torch.zeros(0, 4)), outer=identity).shape == (0, 3)
