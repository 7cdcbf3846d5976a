"""The recipe as a whole: every variant trains, every stream may be missing, every option counts."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF
from sharpfield.recipes.nerf import NeRF
from sharpfield.recipes.settings.presets import prepared
from sharpfield.recipes.volume.scene import VolumeOptions
from sharpfield.rendering.view import render_view
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam

SMALL = VolumeOptions(
    voxels=(12**3, 16**3),
    channels=(4, 2, 2),
    coarse=(8, 7, 8),
    fine=(8, 7, 8),
    octaves=(2, 1),
    samples=(12, 8),
)


def small(recipe: Any, *, kind: str = "planes") -> Any:
    """The recipe at a size for tests; what is modelled stays."""
    kept = {"noise": recipe.volume.noise, "density": recipe.volume.density}
    waits = 10 if getattr(getattr(recipe, "frames", None), "frames_from", 1) > 1 else 1
    recipe = replace(recipe.lasting(12), volume=replace(SMALL, kind=kind, **kept), lr=1e-2)
    if isinstance(recipe, NeRF):
        return replace(recipe, pixels=64)
    few = {"pixels": 48, "blurred_pixels": 16, "instants": 3}
    return replace(
        recipe,
        frames=replace(recipe.frames, blur_from=9, frames_from=waits, **few),
        kernel=replace(recipe.kernel, motions=2),
        events=replace(recipe.events, pairs=48),
        tv_weight=1e-3,
    )


def variant(name: str, capture: Capture) -> Any:
    """A named variant of the recipe, small."""
    full = prepared("ev-deblur-nerf", f"{name},paper", capture=capture, device="cpu")
    return small(full)


def mean_loss(model: Any, steps: range) -> float:
    """The mean of the whole loss over some steps, without learning."""
    with torch.no_grad():
        return sum(
            float(torch.stack(list(model.losses(model.draw(s), s).values())).sum()) for s in steps
        ) / len(steps)


def train(model: Any, steps: int) -> None:
    """Some steps of the trainer's own loop."""
    fit(model, adam(model), steps=range(steps))


@pytest.mark.parametrize(
    ("name", "streams"),
    [(name, "both") for name in sorted(EvDeblurNeRF.presets.variants)]
    + [("physical", "frames"), ("physical", "events"), ("cdavis_full", "frames")],
)
def test_every_variant_learns_from_whatever_there_is(
    tiny: Capture, name: str, streams: str
) -> None:
    capture = {
        "both": tiny,
        "frames": tiny.without(events=True),
        "events": tiny.without(frames=True),
    }[streams]
    recipe = replace(variant(name, tiny), lr=2e-2)
    model = recipe.build(capture, 0)
    probe = range(recipe.steps, recipe.steps + 2)
    before = mean_loss(model, probe)
    train(model, recipe.steps)
    assert mean_loss(model, probe) < before


def test_one_batch_is_learned_by_heart(tiny: Capture) -> None:
    model = small(NeRF()).build(tiny, 0)
    batch, optimizer = model.draw(0), adam(model)
    losses = []
    for _ in range(30):
        loss = torch.stack(list(model.losses(batch, 0).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize("kind", ["planes", "mlp", "voxels"])
def test_every_field_trains_and_renders(tiny: Capture, kind: str) -> None:
    recipe = small(prepared_physical(tiny), kind=kind)
    model = recipe.build(tiny, 0)
    train(model, 3)
    pose = model.capture.frame_pose(torch.arange(1).numpy())[0]
    seen = render_view(model.render, model.capture.camera, pose, 0.5)
    assert seen.rgb.shape == (16, 16, 3)
    shown = model.encode(seen.rgb)
    assert bool(((shown >= 0) & (shown <= 1)).all())


def prepared_physical(capture: Capture) -> Any:
    """The physical variant at full size."""
    return prepared("ev-deblur-nerf", "physical,paper", capture=capture, device="cpu")


def test_a_step_depends_on_seed_and_step_alone(tiny: Capture) -> None:
    recipe = variant("blender_full", tiny)
    first, second = recipe.build(tiny, 5), recipe.build(tiny, 5)
    first.losses(first.draw(3), 3)  # what was looked at before does not matter
    one, other = (m.losses(m.draw(20), 20) for m in (first, second))
    assert one.keys() == other.keys()
    for name in one:
        assert torch.equal(one[name], other[name]), name


def test_weights_are_all_the_state_there_is(tiny: Capture) -> None:
    recipe = variant("cdavis_full", tiny)
    trained, fresh = recipe.build(tiny, 0), recipe.build(tiny, 1)
    train(trained, 4)
    fresh.load_state_dict(trained.state_dict())
    rays = trained.events.sensor(0).expose(trained.draw(0)["events"])
    a, b = trained.render(rays), fresh.render(rays)
    assert torch.equal(a.rgb, b.rgb)


def test_nothing_left_to_learn_from_is_an_error(tiny: Capture) -> None:
    recipe = small(EvDeblurNeRF())
    recipe = replace(
        recipe, frames=replace(recipe.frames, pixels=0), events=replace(recipe.events, weight=0.0)
    )
    with pytest.raises(OptionError, match="nothing is left to learn from"):
        recipe.build(tiny, 0)


def test_switching_terms_off_leaves_them_out(tiny: Capture) -> None:
    whole = variant("blender_full", tiny)

    def terms(recipe: Any, step: int) -> set[str]:
        model = recipe.build(tiny, 0)
        return set(model.losses(model.draw(step), step))

    assert terms(whole, 0) == {"blur", "prior", "events", "smooth"}
    assert terms(whole, 11) == {"blur", "adaptive", "prior", "events", "smooth"}
    no_prior = replace(whole, prior=replace(whole.prior, weight=0.0))
    assert terms(no_prior, 0) == {"blur", "events", "smooth"}
    no_events = replace(whole, events=replace(whole.events, weight=0.0))
    assert terms(no_events, 0) == {"blur", "smooth"}
    rigid = replace(whole, kernel=replace(whole.kernel, adaptive=False))
    assert "adaptive" not in terms(rigid, 11)
    real = variant("cdavis_full", tiny)
    assert terms(real, 0) == {"prior", "events", "smooth"}
    alone = replace(real, prior=replace(real.prior, weight=0.0))
    assert "blur" in terms(alone, 0), "without a prior the frames count from the start"


def test_stretching_keeps_the_published_milestones_in_proportion() -> None:
    recipe = EvDeblurNeRF()
    assert recipe.lasting(30_000) == recipe
    short = recipe.lasting(3000)
    assert (short.frames.blur_from, short.lr_decay_steps, short.kernel.adaptive_share_every) == (
        120,
        1000,
        1000,
    )
    assert (short.prior.until, short.events.response_from) == (1000, 120)


def test_published_rates_and_prior_weights(tiny: Capture) -> None:
    recipe = replace(small(EvDeblurNeRF()), steps=30_000, lr_decay_steps=10_000, lr=5e-3)
    recipe = replace(recipe, prior=replace(recipe.prior, until=10_000))
    model = recipe.build(tiny, 0)
    # Iteration i (step i - 1) uses the exponent (i - 2) / 10 000.
    for step, rate in ((0, 5e-3), (1, 5e-3), (1201, 3.792888e-3), (10_001, 5e-4), (20_001, 5e-5)):
        assert model.groups()[0].rate(step) == pytest.approx(rate, rel=1e-6)
    weights = {0: 0.01, 1200: 9.64923e-3, 5000: 5.005e-3, 7500: 1.473002e-3, 12_000: 1e-5}
    for step, weight in weights.items():
        assert model.frames.prior_weight(step) == pytest.approx(weight, rel=1e-5)


def test_unknown_presets_are_named(tiny: Capture) -> None:
    with pytest.raises(OptionError, match="no preset 'blender'"):
        prepared("ev-deblur-nerf", "blender", capture=tiny, device="cpu")


def test_presets_left_open_follow_the_machine(tiny: Capture) -> None:
    draft, standard = (
        prepared("ev-deblur-nerf", "", capture=tiny, device=device) for device in ("cpu", "cuda")
    )
    assert draft.frames.blur == standard.frames.blur == "auto"
    assert draft.steps < standard.steps
    paper = prepared("ev-deblur-nerf", "paper", capture=tiny, device="cpu")
    assert paper.volume.precision == "auto", "which changes no result by more than noise"
    paper = replace(paper, volume=replace(paper.volume, precision="float32"))
    assert paper == EvDeblurNeRF(), "the recipe's defaults are the paper's synthetic numbers"
    assert set(EvDeblurNeRF.presets.sizes) == {"draft", "standard", "paper"}


def _finite(terms: dict[str, Tensor]) -> bool:
    return all(bool(torch.isfinite(term)) for term in terms.values())


def test_all_terms_stay_finite(tiny: Capture) -> None:
    model = variant("physical", tiny).build(tiny, 0)
    assert all(_finite(model.losses(model.draw(step), step)) for step in (0, 8, 11))
