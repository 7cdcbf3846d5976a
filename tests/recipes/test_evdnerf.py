"""EvDNeRF as published: its golden numbers, its curriculum, and that it learns."""

from dataclasses import replace

import pytest
import torch

from sharpfield.core.errors import CaptureError
from sharpfield.recipes.evdnerf import Curriculum, EvDNeRF
from sharpfield.recipes.volume.moving_scenes import WarpedOptions
from sharpfield.training.optim import adam
from tests.recipes.moving import tiny_moving

SMALL = EvDNeRF(
    steps=40,
    lr=5e-3,
    pairs=48,
    curriculum=Curriculum(
        windows=(4, 8), stages=(0, 30), crop_steps=4, opening_steps=8, warmup_steps=3
    ),
    scene=WarpedOptions(width=16, depth=6, samples=(8, 8)),
)


def test_rates_at_golden_steps():
    curriculum = EvDNeRF().curriculum
    rates = [curriculum.lr_factor(s) for s in (0, 500, 1000, 99_999, 100_000, 150_500, 180_000)]
    assert rates == pytest.approx([0.1, 0.55, 1.0, 1.0, 0.1, 0.55, 1.0])


def test_windows_are_halved_twice():
    curriculum = EvDNeRF().curriculum
    at = [curriculum.windows[curriculum.stage(s)] for s in (0, 99_999, 100_000, 150_000)]
    assert at == [31, 31, 63, 127]


def test_a_shrunk_schedule_keeps_its_proportions():
    made = EvDNeRF().lasting(2000).curriculum
    assert made.stages == (0, 1000, 1500)
    assert (made.crop_steps, made.opening_steps, made.warmup_steps) == (20, 200, 10)


def test_predicting_nothing_costs_the_mean_square_of_scaled_counts():
    """The published sanity value: all light 0.5 at first, so that nothing changes."""
    model = SMALL.build(tiny_moving(), 0)
    seen = model.draw(0)["events"]
    measured = seen.measured(*model.threshold)
    found = model.error(torch.zeros(len(seen)), seen, 0)
    torch.testing.assert_close(found, (measured / model.largest_change(0)).square().mean())


def test_the_loss_is_least_at_the_compressed_change():
    """D = 2.2 E / M; events are recovered by the inverse factor."""
    model = SMALL.build(tiny_moving(), 0)
    seen = model.draw(0)["events"]
    best = 2.2 * seen.measured(*model.threshold) / model.largest_change(0)
    assert float(model.error(best, seen, 0)) < 1e-12
    light = torch.tensor([[0.2], [0.4]])
    change = model.log_light(light)[1] - model.log_light(light)[0]
    expected = torch.tensor(2.0).log() * model.largest_change(SMALL.steps) / 2.2
    torch.testing.assert_close(change, expected)


def test_all_light_is_used_and_a_constant_never_changes():
    """Released rendering: weights sum to one, whatever is in the scene."""
    model = SMALL.build(tiny_moving(), 0)
    rays = model.sensor.expose(model.draw(0)["events"])
    light = model.scene.sharp(rays, 0, "events")
    torch.testing.assert_close(light.opacity, torch.ones(rays.shape))


@pytest.mark.parametrize("shared", [False, True])
def test_only_shared_jitter_keeps_still_what_stands_still(shared: bool):
    scene = replace(SMALL.scene, shared_jitter=shared)
    model = replace(SMALL, scene=scene).build(tiny_moving(), 0)
    with torch.no_grad():
        for parameter in model.scene.field.deformation.parameters():
            parameter.zero_()
    seen = model.draw(0)["events"]
    change = model.sensor.observe(model.scene.sharp(model.sensor.expose(seen), 0, "e"), seen)
    assert (float(change.detach().abs().max()) < 1e-6) == shared


def test_the_coarse_network_learns_only_if_told():
    scene = replace(SMALL.scene, networks=2)
    for told in (False, True):
        model = replace(SMALL, scene=scene, coarse_loss=told).build(tiny_moving(), 0)
        sum(model.losses(model.draw(0), 0).values()).backward()
        coarse = model.scene.field.field.coarse.last.weight.grad
        assert (coarse is not None and bool(coarse.any())) == told


def test_forty_steps_explain_a_batch():
    """Better than predicting nothing."""
    model = replace(SMALL, lr=2e-2).build(tiny_moving(), 0)
    optimizer, seen = adam(model), model.draw(20)["events"]
    nothing = model.error(torch.zeros(len(seen)), seen, 20)
    loss = nothing
    for _ in range(40):
        loss = model.losses({"events": seen}, 20)["events"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.9 * nothing.item()


def test_it_needs_events():
    with pytest.raises(CaptureError, match="needs events"):
        SMALL.build(tiny_moving().without(events=True), 0)
