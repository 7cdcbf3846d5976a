import pytest
import torch

from sharpfield.core.protocols import PointSet
from sharpfield.core.seed import generator
from sharpfield.fields.gaussians.densify import (
    PRUNE_OPACITY,
    GradientStats,
    densify_and_prune,
    reset_opacity,
)
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.training.optim import apply_growth

SMALL, LARGE, HUGE = 0.005, 0.05, 0.5
"""Scales in a scene of extent 1."""


def chance(step: int = 0) -> torch.Generator:
    return generator(0, step, "growth")


def scene(scales: list[float], opacities: list[float] | None = None) -> Gaussians:
    count = len(scales)
    points = torch.arange(3.0 * count).reshape(count, 3)
    made = Gaussians.start(points, torch.rand(count, 3), torch.tensor(scales))
    if opacities is not None:
        made.opacity_logits.data = torch.tensor(opacities).logit()
    return made


def densified(made: Gaussians, mean_grad: list[float], *, cap_max: int = 99):
    return densify_and_prune(
        made, torch.tensor(mean_grad), 1.0, cap_max=cap_max, generator=chance()
    )


def test_small_ones_are_cloned():
    growth = densified(scene([SMALL, SMALL]), [0.0, 1.0])
    assert growth is not None
    assert growth.source.tolist() == [0, 1, 1] and growth.fresh.tolist() == [False, False, True]
    assert torch.equal(growth.values["means"][1], growth.values["means"][2])


def test_large_ones_are_split():
    made = scene([LARGE, LARGE])
    growth = densified(made, [0.0, 1.0])
    assert growth is not None
    assert growth.source.tolist() == [0, 1, 1] and growth.fresh.tolist() == [False, True, True]
    torch.testing.assert_close(
        growth.values["log_scales"].exp()[1:], torch.full((2, 3), LARGE / 1.6)
    )
    offset = growth.values["means"][1:] - made.means[1]
    assert offset.norm(dim=-1).min() > 0 and offset.abs().max() < 5 * LARGE


def test_halves_are_distributed_as_the_whole_was():
    made = scene([LARGE] * 4000)
    made.log_scales.data = torch.tensor([0.09, 0.05, 0.02]).log().repeat(4000, 1)
    made.quaternions.data = torch.tensor([1.0, 0.0, 0.0, 1.0]).repeat(4000, 1)  # x becomes y
    growth = densified(made, [1.0] * 4000, cap_max=9999)
    assert growth is not None
    offset = growth.values["means"] - made.means.detach()[growth.source]
    torch.testing.assert_close(offset.std(0), torch.tensor([0.05, 0.09, 0.02]), rtol=0.05, atol=0)


def test_the_transparent_and_the_huge_are_dropped():
    made = scene([SMALL, SMALL, HUGE], [0.5 * PRUNE_OPACITY, 0.5, 0.5])
    growth = densified(made, [1.0, 0.0, 1.0])
    assert growth is not None and growth.source.tolist() == [1]


def test_those_of_the_largest_gradient_come_first_up_to_the_maximum():
    growth = densified(scene([SMALL, LARGE, SMALL, SMALL]), [1.0, 3.0, 2.0, 0.0], cap_max=6)
    assert growth is not None
    assert growth.source.tolist() == [0, 2, 3, 2, 1, 1]
    full = densified(scene([SMALL] * 3), [1.0] * 3, cap_max=3)
    assert full is None


def test_content_gaussians_stay_as_they_are():
    assert densified(scene([SMALL, LARGE]), [1e-4, 1e-4]) is None
    assert densify_and_prune(scene([]), torch.zeros(0), 1.0, cap_max=9, generator=chance()) is None


def test_gradients_are_averaged_over_the_views_that_saw_a_splat():
    stats = GradientStats(3)
    pull = torch.zeros(2, 3, 2)
    pull[0, 0], pull[1, 0], pull[1, 1] = (
        torch.tensor([0.03, 0.04]),
        torch.tensor([0.06, 0.08]),
        torch.tensor([0.3, 0.4]),
    )
    stats.add(pull, (200, 200))
    torch.testing.assert_close(stats.mean_grad, torch.tensor([7.5, 50.0, 0.0]))
    stats.add(pull[:1] * 3, (200, 200))
    torch.testing.assert_close(stats.mean_grad, torch.tensor([10.0, 50.0, 0.0]))


def test_statistics_start_again_when_gaussians_grow():
    made, stats = scene([SMALL, SMALL]), GradientStats(2)
    assert isinstance(stats, PointSet)
    stats.add(torch.ones(1, 2, 2), (2, 2))
    growth = densified(made, [1.0, 1.0])
    assert growth is not None
    optimizer = torch.optim.Adam(made.parameters())
    apply_growth(made, optimizer, growth)
    apply_growth(stats, optimizer, stats.cleared(growth))
    assert len(made) == len(stats.mean_grad) == 4 and not stats.mean_grad.any()
    assert set(stats.state_dict()) == {"total", "views"}
    stats.add(torch.ones(1, 4, 2), (2, 2))
    torch.testing.assert_close(stats.mean_grad, torch.full((4,), 2**0.5))


def test_fading_leaves_the_faint_alone_and_their_moments():
    made = scene([SMALL, SMALL], [0.006, 0.9])
    optimizer = torch.optim.Adam(made.parameters())
    made.opacities.sum().backward()
    optimizer.step()
    growth = reset_opacity(made.opacity_logits)
    apply_growth(made, optimizer, growth)
    assert made.opacities.tolist() == pytest.approx([0.006, 0.01], rel=2e-2)
    assert (optimizer.state[made.opacity_logits]["exp_avg"] != 0).tolist() == [True, False]


def test_it_depends_on_its_generator_alone():
    first, again = (densified(scene([LARGE]), [1.0]) for _ in range(2))
    assert first is not None and again is not None
    assert torch.equal(first.values["means"], again.values["means"])
