import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Pixels
from sharpfield.core.rays import Radiance, Samples
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma
from sharpfield.geometry.normalise import normalised
from sharpfield.recipes.volume.learned_blur import KernelOptions, LearnedBlur, share_of_adaptive

PIXELS, RAYS, POINTS, FEATURES = 5, 4, 6, 7


def blur(capture: Capture, *, features: int = FEATURES, **change) -> LearnedBlur:
    options = KernelOptions(motions=RAYS - 1, norm="layer", **change)
    return LearnedBlur(options, normalised(capture)[0], gamma, features=features, seed=0)


def pixels() -> Pixels:
    made = generator(0, 0, "pixels")
    zero = torch.zeros(PIXELS)
    return Pixels(
        xy=torch.rand(PIXELS, 2, generator=made) * 16,
        frame=torch.arange(PIXELS),
        track=torch.zeros(PIXELS, dtype=torch.int64),
        open=zero + 0.1,
        close=zero + 0.2,
        value=torch.rand(PIXELS, 3, generator=made),
    )


def light(rgb: torch.Tensor, weight: torch.Tensor) -> Radiance:
    """Light of exposed rays, with samples; the coarse stage sees the same."""
    made = generator(0, 0, "samples")
    depth = torch.linspace(0, 1, POINTS).expand(PIXELS, RAYS, POINTS)
    feature = torch.randn(PIXELS, RAYS, POINTS, FEATURES, generator=made)
    one = torch.ones(PIXELS, RAYS)
    samples = Samples(depth, feature, torch.ones(PIXELS, RAYS, 3))
    coarse = Radiance(rgb, one, one, weight)
    return Radiance(rgb, one, one, weight, coarse=coarse, samples=samples)


def varied(capture: Capture, learned: LearnedBlur) -> Radiance:
    rgb = torch.rand(PIXELS, RAYS, 3, generator=generator(0, 0, "light"))
    return light(rgb, learned.kernel.expose(pixels()).weight)


def test_trust_golden():
    at = share_of_adaptive(KernelOptions(), begin=1200, steps=30_000)
    wanted = {1200: 0.1, 9999: 0.1, 10_000: 0.195688, 20_000: 0.419649, 30_000: 0.899931}
    found = {iteration: at(iteration) for iteration in wanted}
    assert found == pytest.approx(wanted, abs=5e-7)


def test_trust_is_a_staircase_that_never_falls():
    at = share_of_adaptive(KernelOptions(adaptive_share_every=100), begin=150, steps=1000)
    values = [at(iteration) for iteration in range(1, 1001)]
    assert sorted(values) == values
    assert len(set(values)) == 10  # 100 lies before 150: still the first value
    assert values[0] == 0.1


def test_one_colour_everywhere_has_the_same_error_under_any_weights(tiny: Capture):
    learned, seen = blur(tiny), pixels()
    grey = light(torch.full((PIXELS, RAYS, 3), 0.3), learned.kernel.expose(seen).weight)
    terms = learned.losses(grey, seen, share=0.25, rigid=True)
    error = (gamma(torch.tensor(0.3)) - seen.value).square().mean()
    torch.testing.assert_close(terms["blur"], 0.75 * 2 * error)  # two stages
    torch.testing.assert_close(terms["adaptive"], 0.25 * error)  # the fine one alone


def test_trust_divides_the_loss(tiny: Capture):
    learned, seen = blur(tiny), pixels()
    found = [
        learned.losses(varied(tiny, learned), seen, share=share, rigid=True)
        for share in (0.0, 0.4, 1.0)
    ]
    assert found[0]["adaptive"] == 0 and found[2]["blur"] == 0
    torch.testing.assert_close(found[1]["blur"], 0.6 * found[0]["blur"])
    torch.testing.assert_close(found[1]["adaptive"], 0.4 * found[2]["adaptive"])
    assert found[0]["blur"] > 0 and found[2]["adaptive"] > 0


def test_before_the_rigid_term_counts_only_the_adaptive_one_does(tiny: Capture):
    learned = blur(tiny)
    terms = learned.losses(varied(tiny, learned), pixels(), share=0.1, rigid=False)
    assert terms.keys() == {"adaptive"}


@pytest.mark.parametrize("without", [{"adaptive": False}, {"features": 0}])
def test_without_a_network_all_trust_is_in_the_kernel(tiny: Capture, without: dict):
    learned, seen = blur(tiny, **without), pixels()
    terms = learned.losses(varied(tiny, learned), seen, share=0.9, rigid=True)
    full = blur(tiny).losses(varied(tiny, learned), seen, share=0.0, rigid=True)
    assert terms.keys() == {"blur"}
    torch.testing.assert_close(terms["blur"], full["blur"])


def test_the_seed_decides_how_it_starts(tiny: Capture):
    options = KernelOptions(motions=2)
    path = normalised(tiny)[0]
    first, same, other = (
        LearnedBlur(options, path, gamma, features=FEATURES, seed=seed).state_dict()
        for seed in (0, 0, 1)
    )
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_every_parameter_learns(tiny: Capture):
    learned, seen = blur(tiny), pixels()
    for code in learned.motions.parameters():  # those of the frames start at zero
        torch.nn.init.normal_(code, std=0.3, generator=generator(0, 0, "grown"))
    rays = learned.kernel.expose(seen)
    bright = light(torch.sigmoid(rays.origin + rays.direction), rays.weight)
    terms = learned.losses(bright, seen, share=0.5, rigid=True)
    torch.stack(list(terms.values())).sum().backward()
    idle = [
        name
        for name, p in learned.named_parameters()
        if p.grad is None or not p.grad.isfinite().all() or not p.grad.any()
    ]
    assert not idle
