import copy
from dataclasses import replace

import pytest
import torch

from sharpfield.core.protocols import Response
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma, luma
from sharpfield.formation.response import FixedResponse, LearnedResponse, LogResidual, passed
from tests.formation.toy import pairs

LEARNED = LearnedResponse()
EVEN = torch.linspace(0, 1, 21)


def residual(**options) -> LogResidual:
    return LogResidual(generator=generator(0, 0, "response"), **options)


def bent(**options) -> LogResidual:
    """With heights far larger than training would make them."""
    made = residual(**options)
    with torch.no_grad():
        made.heights += 5 * torch.randn(16, generator=generator(0, 0, "heights"))
    return made


def grey(sign: float, light: torch.Tensor = EVEN):
    """Grey light `[b, 1, 3]`, at pairs with an event of a sign, or none."""
    seen = pairs(len(light))
    signs = torch.full_like(light, sign)
    seen = replace(seen, negative=signs.clamp(max=0), positive=signs.clamp(min=0))
    return light[:, None, None].expand(-1, 1, 3), seen


@pytest.mark.parametrize("response", [FixedResponse(), LEARNED, residual()])
def test_all_can_take_each_others_place(response):
    assert isinstance(response, Response)
    for seen in (pairs(), pairs(bayer=True)):
        assert response(torch.rand(7, 2, 3), seen).shape == (7, 2, 1)
    assert response(torch.rand(7, 2, 1), pairs()).shape == (7, 2, 1)
    assert response(torch.rand(0, 2, 3), pairs(0)).shape == (0, 2, 1)


def test_luma_of_grey_is_grey():
    torch.testing.assert_close(luma(grey(0)[0])[:, 0], EVEN)


def test_a_filter_passes_its_own_colour():
    light, seen = torch.rand(7, 2, 3), pairs(bayer=True)
    own = torch.stack([light[b, :, c] for b, c in enumerate(seen.channel)])
    assert torch.equal(passed(light, seen)[..., 0], own)
    assert passed(light, pairs()) is light


def test_a_fixed_response_bends_each_colour_before_luma():
    light = torch.rand(7, 2, 3)
    expected = ((gamma(light) * torch.tensor([0.299, 0.587, 0.114])).sum(-1) + 1e-5).log()
    torch.testing.assert_close(FixedResponse(gamma)(light, pairs())[..., 0], expected)


# --- the published curve ---


def test_it_has_625_parameters_or_593_without_polarity():
    assert sum(p.numel() for p in LEARNED.parameters()) == 625
    without = LearnedResponse(inputs="light", steps=1)
    assert sum(p.numel() for p in without.parameters()) == 593


@pytest.mark.parametrize("sign", [-1, 0, 1])
def test_it_starts_near_the_identity_for_any_polarity(sign):
    light, seen = grey(sign)
    curve = LEARNED.curve(light, seen)[:, 0, 0]
    assert (curve - EVEN).square().mean() < 2e-4
    assert (curve - EVEN).abs().max() < 0.035


def test_the_released_start_is_near_the_identity_without_events_only():
    released = LearnedResponse(polarity_start="random")
    errors = [(released.curve(*grey(sign))[:, 0, 0] - EVEN).square().mean() for sign in (0, -1, 1)]
    assert errors[0] < 2e-4 < 1e-3 < min(errors[1:])


def test_it_is_the_sigmoid_of_light_plus_a_tenth_of_a_network():
    light, seen = torch.rand(7, 2, 3), pairs()
    other = LearnedResponse(polarity_start="random", steps=20)
    for b in range(7):
        for c in range(3):
            x = torch.stack([light[b, 0, c], seen.negative[b], seen.positive[b]])
            hidden = x
            *inner, last = other.network.layers
            for layer in inner:
                hidden = torch.relu(layer(hidden))
            expected = torch.sigmoid(x[0] + 0.1 * last(hidden)[0])
            torch.testing.assert_close(other.curve(light, seen)[b, 0, c], expected)


def test_behind_a_filter_only_the_own_colour_reads_polarity():
    """The published rule, in full: all three colours, two of them with zero counts."""
    response = LearnedResponse(polarity_start="random", steps=20)
    light, seen = torch.rand(7, 2, 3), pairs(bayer=True)
    counts = torch.zeros(7, 2, 3, 2)
    for b, own in enumerate(seen.channel):
        counts[b, :, own, 0], counts[b, :, own, 1] = seen.negative[b], seen.positive[b]
    read = torch.cat([light[..., None], counts], -1)
    all_three = torch.sigmoid(light + 0.1 * response.network(read)[..., 0])
    expected = (passed(all_three, seen) + 1e-5).log()
    torch.testing.assert_close(response(light, seen), expected)


def test_building_one_is_repeatable_and_leaves_the_global_generator_alone():
    before = torch.random.get_rng_state()
    first, second = LearnedResponse(steps=20), LearnedResponse(steps=20)
    assert torch.equal(torch.random.get_rng_state(), before)
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(a, b)


def test_the_polarity_columns_learn_though_they_start_at_zero():
    response = LearnedResponse(steps=20)
    response(torch.rand(7, 2, 3), pairs()).sum().backward()
    first = next(response.parameters())
    assert first[:, 1:].abs().max() == 0 and first.grad[:, 1:].abs().max() > 0


# --- the residual ---


@pytest.mark.parametrize("sign", [-1, 0, 1])
def test_it_starts_as_the_logarithm_exactly(sign):
    light, seen = grey(sign)
    assert torch.equal(residual()(light, seen), FixedResponse()(light, seen))


@pytest.mark.parametrize("sign", [-1, 0, 1])
def test_a_bounded_residual_always_rises_with_light(sign):
    dark_to_bright = torch.logspace(-7, 0, 400)
    rises = bent()(*grey(sign, dark_to_bright))[:, 0, 0].diff()
    assert (rises > 0).all()
    free = bent(slope=None)(*grey(sign, dark_to_bright))[:, 0, 0].diff()
    assert not (free > 0).all()


def test_a_residual_within_its_bound_is_left_as_it_is():
    learned, free = residual(), residual(slope=None)
    with torch.no_grad():
        for made in (learned, free):
            made.heights += 0.01
    light, seen = torch.rand(7, 2, 3), pairs()
    assert torch.equal(learned(light, seen), free(light, seen))
    assert not torch.equal(learned(light, seen), residual()(light, seen))


def test_the_residual_reads_polarity_if_told_to():
    for inputs, differ in (("light+polarity", True), ("light", False)):
        made = bent(inputs=inputs)
        up, down = (made(*grey(sign)) for sign in (1, -1))
        assert torch.equal(up, down) is not differ


def test_the_residual_can_learn_from_its_start():
    made = residual()
    light, seen = torch.rand(7, 2, 3), pairs()
    made(light, seen)[:, 1].sum().backward()
    assert made.heights.grad is not None and made.heights.grad.abs().min() > 0


@pytest.mark.parametrize("response", [LEARNED, residual(), bent()])
def test_gradients(response):
    response = copy.deepcopy(response).double()
    light = (0.05 + torch.rand(7, 2, 3, dtype=torch.float64)).requires_grad_()
    seen = pairs().map(lambda x, _: x.double() if x.is_floating_point() else x)
    assert torch.autograd.gradcheck(lambda x: response(x, seen), light)
