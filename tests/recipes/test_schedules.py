"""When the parts of Ev-DeblurNeRF begin, as published: iterations count from 1, steps from 0."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.formation.response import FixedResponse
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF, blender_full, blender_minus, cdavis_full
from sharpfield.recipes.volume.scene import VolumeOptions

TINY = VolumeOptions(
    voxels=(4**3, 6**3),
    channels=(2, 2, 2),
    coarse=(4, 3, 4),
    fine=(4, 3, 4),
    octaves=(1, 1),
    samples=(4, 4),
)


def model(variant: Any, capture: Capture) -> Any:
    """A variant on few pixels and pairs; its schedule is the published one."""
    recipe = variant(EvDeblurNeRF())
    return replace(
        recipe,
        volume=TINY,
        frames=replace(recipe.frames, pixels=6, blurred_pixels=4),
        events=replace(recipe.events, pairs=6),
    ).build(capture, 0)


def terms(made: Any, step: int) -> set[str]:
    with torch.no_grad():
        return set(made.losses(made.draw(step), step))


@pytest.mark.parametrize(
    ("variant", "wanted"),
    [
        (
            blender_full,
            {0: {"blur", "prior"}, 1198: {"blur", "prior"}, 1199: {"blur", "adaptive", "prior"}},
        ),
        (blender_minus, {0: {"blur"}, 1198: {"blur"}, 1199: {"blur", "adaptive"}}),
        (
            cdavis_full,
            {
                0: {"prior"},
                1198: {"prior"},
                1199: {"adaptive", "prior"},  # as released: the rigid term follows one later
                1200: {"blur", "adaptive", "prior"},
            },
        ),
    ],
)
def test_terms_of_the_loss(tiny: Capture, variant: Any, wanted: dict[int, set[str]]):
    made = model(variant, tiny)
    for step, names in wanted.items():
        assert terms(made, step) == names | {"events", "smooth"}


def test_each_pixel_has_one_ray_before_the_kernel_and_ten_after(tiny: Capture):
    made = model(blender_full, tiny)
    assert not made.frames.blurred(1198) and made.frames.blurred(1199)
    assert made.frames.blur.kernel.expose(made.draw(1199)["frames"]).shape == (4, 10)
    assert made.heaviest_step == 1199


def test_events_are_seen_in_linear_light_before_their_response_is_learned(tiny: Capture):
    made = model(blender_full, tiny)
    assert isinstance(made.events.sensor(1198).response, FixedResponse)
    assert made.events.sensor(1199).response is made.events.learned


def test_without_a_learned_response_it_never_changes(tiny: Capture):
    made = model(blender_minus, tiny)
    assert made.events.sensor(0).response is made.events.sensor(20_000).response


def test_learning_rates(tiny: Capture):
    """Iteration i uses the exponent (i - 2) / 10 000: the rate falls after each step."""
    for group in model(blender_full, tiny).groups():
        rates = [group.rate(step) for step in (0, 1, 1201, 10_001, 20_001)]
        assert rates == pytest.approx([5e-3, 5e-3, 3.792888e-3, 5e-4, 5e-5], rel=1e-6), group.name


def test_without_a_prior_frames_count_at_once(tiny: Capture):
    def unguided(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
        recipe = cdavis_full(recipe)
        return replace(recipe, prior=replace(recipe.prior, weight=0.0))

    assert terms(model(unguided, tiny), 0) == {"blur", "events", "smooth"}
