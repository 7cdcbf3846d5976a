import math

import pytest
import torch

from sharpfield.core.protocols import Growth
from sharpfield.core.seed import generator
from sharpfield.fields.gaussians.mcmc import (
    MIN_OPACITY,
    opacity_scale_penalty,
    position_noise,
    relocate_and_add,
    relocated_opacity_scale,
)
from sharpfield.fields.gaussians.static import Gaussians


def chance(step: int = 0) -> torch.Generator:
    return generator(0, step, "growth")


def crowd(count: int = 40, *, dead: int = 10) -> tuple[torch.Tensor, torch.Tensor]:
    """Log scales and opacity logits; the first ones are dead."""
    opacity = torch.linspace(0.02, 0.98, count)
    opacity[:dead] = 0.001
    scales = torch.randn(count, 3, generator=generator(0, 0, "scales"))
    return scales, opacity.logit()


def grown(cap_max: int = 40, **options) -> tuple[Growth, torch.Tensor, torch.Tensor]:
    scales, logits = crowd(**options)
    growth = relocate_and_add(scales, logits, cap_max=cap_max, generator=chance())
    assert growth is not None
    return growth, scales, logits


@pytest.mark.parametrize("shares", [1, 2, 5, 51])
@pytest.mark.parametrize("opacity", [0.3, 0.9, 0.999])
def test_sharing_changes_neither_the_centre_nor_the_sum_along_a_line(shares: int, opacity: float):
    """The integral of eq. 9, by brute force."""
    one = torch.tensor([opacity], dtype=torch.float64)
    new, factor = relocated_opacity_scale(one, torch.tensor([shares]))
    x = torch.linspace(-9, 9, 20_001, dtype=torch.float64)
    alone = one * torch.exp(-(x**2) / 2)
    each = new * torch.exp(-(x**2) / (2 * factor**2))
    together = 1 - (1 - each) ** shares
    assert together.max().item() == pytest.approx(alone.max().item(), rel=1e-9)
    # The paper matches the sum of what each of the N stops on its own turn.
    turns = sum(each * (1 - each) ** i for i in range(shares))
    torch.testing.assert_close(turns, together)
    assert turns.sum().item() == pytest.approx(alone.sum().item(), rel=1e-6)


def test_the_sum_over_shares_is_that_of_the_paper():
    opacity = torch.tensor([0.2, 0.7, 0.95], dtype=torch.float64)
    _, factor = relocated_opacity_scale(opacity, torch.full((3,), 6))
    for o, found in zip(opacity.tolist(), factor.tolist(), strict=True):
        new = max(1 - (1 - o) ** (1 / 6), MIN_OPACITY)
        stopped = 0.0
        for i in range(1, 7):
            for k in range(i):
                stopped += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        assert found == pytest.approx(o / stopped, rel=1e-9)


def test_the_dead_move_to_the_live_and_their_number_stays():
    growth, _, logits = grown()
    assert len(growth) == 40
    assert (growth.source[:10] >= 10).all() and growth.fresh[:10].all()
    assert torch.equal(growth.source[10:], torch.arange(10, 40)) and not growth.fresh[10:].any()
    assert (growth.values["opacity_logits"].sigmoid() >= 0.99 * MIN_OPACITY).all()


def test_all_who_share_a_place_become_alike_and_others_stay():
    growth, scales, logits = grown()
    new_logits, new_scales = growth.values["opacity_logits"], growth.values["log_scales"]
    chosen = growth.source[:10]
    for seat, live in enumerate(chosen.tolist()):
        assert new_logits[seat] == new_logits[live] < logits[live]
        assert torch.equal(new_scales[seat], new_scales[live])
    alone = torch.ones(40, dtype=torch.bool)
    alone[:10] = False
    alone[chosen] = False
    assert torch.equal(new_logits[alone], logits[alone])
    assert torch.equal(new_scales[alone], scales[alone])


def test_it_grows_by_a_twentieth_up_to_the_maximum():
    growth, *_ = grown(cap_max=1000, count=40, dead=0)
    assert len(growth) == 42 and growth.fresh.tolist() == [False] * 40 + [True] * 2
    growth, *_ = grown(cap_max=41, count=40, dead=0)
    assert len(growth) == 41
    assert relocate_and_add(*crowd(dead=0), cap_max=40, generator=chance()) is None
    assert (
        relocate_and_add(*crowd(dead=0), cap_max=7, generator=chance()) is None
    )  # none are taken away


def test_the_opaque_are_chosen_more_often():
    logits = torch.tensor([0.1, 0.3, 0.6, 0.001]).logit().repeat(500)
    growth = relocate_and_add(
        torch.zeros(2000, 3), logits, cap_max=9999, generator=chance(), growth=4.0
    )
    assert growth is not None
    kind = growth.source[growth.fresh] % 4
    share = torch.bincount(kind, minlength=4) / len(kind)
    torch.testing.assert_close(share, torch.tensor([0.1, 0.3, 0.6, 0.0]), atol=0.02, rtol=0)


def test_without_anyone_alive_nothing_moves():
    assert relocate_and_add(*crowd(dead=40), cap_max=99, generator=chance()) is None
    none = torch.zeros(0)
    assert relocate_and_add(none.reshape(0, 3), none, cap_max=99, generator=chance()) is None


def test_it_depends_on_its_generator_alone():
    first, again = (relocate_and_add(*crowd(), cap_max=99, generator=chance()) for _ in range(2))
    other = relocate_and_add(*crowd(), cap_max=99, generator=chance(1))
    assert first is not None and again is not None and other is not None
    assert torch.equal(first.source, again.source) and not torch.equal(first.source, other.source)


def scene(opacity: float, count: int = 4000) -> Gaussians:
    shape = torch.tensor([0.3, 0.1, 0.02])
    made = Gaussians.start(torch.zeros(count, 3), torch.ones(count, 3), torch.ones(count))
    made.log_scales.data = shape.log().repeat(count, 1)
    made.quaternions.data = torch.tensor([1.0, 0.0, 0.0, 1.0]).repeat(count, 1)  # x becomes y
    made.opacity_logits.data = torch.full((count,), math.log(opacity / (1 - opacity)))
    return made


def test_noise_has_the_square_of_the_gaussians_shape():
    noise = position_noise(scene(MIN_OPACITY), 1e-3, chance(), noise=100.0)
    wanted = 0.5 * 0.1 * torch.tensor([0.1, 0.3, 0.02]) ** 2  # half open at the threshold itself
    torch.testing.assert_close(noise.std(0), wanted, rtol=0.05, atol=0)


def test_the_opaque_do_not_wander():
    assert position_noise(scene(0.5), 1e-3, chance()).abs().max() < 1e-15
    assert position_noise(scene(1e-4), 1e-3, chance()).std() > 0.1


def test_the_penalty_on_opacity_and_scale():
    made = scene(0.25)
    penalty = opacity_scale_penalty(made)
    assert penalty.item() == pytest.approx(0.25 + 0.42 / 3)
    penalty.backward()
    assert made.log_scales.grad is not None and (made.log_scales.grad > 0).all()
