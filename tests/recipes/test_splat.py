"""The five recipes on Gaussians: all learn, from whatever there is, and resume alike."""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Known
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.measurements import Instants, Pixels
from sharpfield.core.protocols import Growing, Model
from sharpfield.core.rays import Rays, Views
from sharpfield.formation.mixing import mix
from sharpfield.geometry.rolling import Rolling
from sharpfield.geometry.trajectory import Still
from sharpfield.recipes import RECIPES, recipe_named
from sharpfield.recipes.splats.learned_calibration import LearnedCalibrationOptions
from sharpfield.recipes.splats.model import SplatModel
from sharpfield.recipes.splats.scene import GaussianOptions
from sharpfield.rendering.view import ViewRenderer, render_view, renderer_of
from sharpfield.sampling.views import SamplingOptions
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.frames import FrameSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.training.checkpoint import file_of
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import train
from tests.recipes.moving import tiny_moving
from tests.training.toy import quiet

NAMES = ("splat", "edi-splat", "blur-splat", "event-splat", "ev-splat")
STEPS = 24


@functools.cache
def recorded(bayer: str = "") -> Capture:
    """32x24 pixels, six frames of which two are held out."""
    timing = Timing(frames=6, exposure_us=20_000, interval_us=24_000, test_every=4)
    rig = Rig(
        size=(32, 24), event_sensor=EventSensor(threshold_on=0.1, threshold_off=0.1, bayer=bayer)
    )
    return simulate("tiles", rig=rig, timing=timing, seed=3)


def photos() -> Capture:
    """Blurry photos without events, each from a place of its own, whose motion nobody knows."""
    capture = recorded().without(events=True)
    frames = capture.needed_frames
    poses = capture.frame_pose(np.arange(len(frames))).double().numpy()
    middle = frames.exposure.middle_us
    return replace(
        capture,
        trajectory=Still(poses),
        frames=replace(
            frames, track=np.arange(len(frames)), exposure=type(frames.exposure)(middle, middle)
        ),
        known=Known(motion="unknown"),
    )


def small(name: str, **changes: Any) -> Any:
    """A recipe at a size for tests."""
    recipe = replace(recipe_named(name)(), steps=STEPS, **changes)
    gaussians = replace(recipe.gaussians, cap_max=600, start=0.5, grow_every=7)
    return replace(recipe, gaussians=changes.get("gaussians", gaussians))


def learned(model: SplatModel) -> tuple[float, float]:
    """The loss of the last steps' batches, before and after training."""
    steps = model.steps
    probe = [(step, model.draw(step)) for step in range(steps - 4, steps)]

    @torch.no_grad()
    def loss() -> float:
        return sum(float(sum(model.losses(batch, step).values())) for step, batch in probe)

    before = loss()
    fit(model, adam(model), steps=range(steps))
    return before, loss()


CASES = {
    **{f"{name}, both": (name, recorded) for name in NAMES},
    "blur-splat, frames": ("blur-splat", lambda: recorded().without(events=True)),
    "blur-splat, photos": ("blur-splat", photos),
    "splat, photos": ("splat", photos),
    "ev-splat, frames": ("ev-splat", lambda: recorded().without(events=True)),
    "ev-splat, events": ("ev-splat", lambda: recorded().without(frames=True)),
    "event-splat, events": ("event-splat", lambda: recorded().without(frames=True)),
    "ev-splat, colour": ("ev-splat", lambda: recorded("RGGB")),
    "edi-splat, colour": ("edi-splat", lambda: recorded("RGGB")),
    "event-splat, colour": ("event-splat", lambda: recorded("RGGB").without(frames=True)),
}


@pytest.mark.parametrize("case", CASES)
def test_every_recipe_learns_from_whatever_there_is(case: str) -> None:
    name, capture = CASES[case]
    before, after = learned(small(name).build(capture(), 0))
    assert after < 0.8 * before


@pytest.mark.parametrize("growth", ["mcmc", "densify", "none"])
def test_every_way_of_growing_learns(growth: str) -> None:
    gaussians = GaussianOptions(cap_max=600, start=0.5, growth=growth, grow_every=5)
    model = small("splat", gaussians=gaussians).build(recorded(), 0)
    begun = len(model.scene.static)
    before, after = learned(model)
    assert after < 0.8 * before
    count = len(model.scene.static)
    assert count == begun if growth == "none" else begun < count <= 600


def test_everything_unknown_is_learned_at_once() -> None:
    unknowns = LearnedCalibrationOptions(
        threshold=(0.12, 0.12), thresholds="pixels", response="residual",
        gains=True, knots=6, offset=True,
    )  # fmt: skip
    model = small("ev-splat", calibration=unknowns).build(recorded(), 0)
    before, after = learned(model)
    assert after < 0.8 * before
    assert model.calibration.offset_us != 0
    for name, parameter in (*model.calibration.named_parameters(), *model.path.named_parameters()):
        assert torch.isfinite(parameter).all() and parameter.any(), name


def test_the_edi_phase_renders_single_instants_and_later_steps_exposures() -> None:
    model = small("ev-splat", sampling=SamplingOptions(edi_phase=0.5, grad_views=3)).build(
        recorded(), 0
    )
    assert model.sampler.edi_until == model.heaviest_step == STEPS // 2
    early, late = model.draw(STEPS // 2 - 1), model.draw(STEPS // 2)
    assert set(early) == {"views", "latent_frames"} and len(early["views"].time[0]) == 1
    assert set(late) == {"views", "no_grad_views", "frames", "latent_frames", "events"}
    assert len(late["views"].time[0]) == 4 and len(late["no_grad_views"].time[0]) == 6
    terms = model.losses(late, STEPS // 2)
    assert set(terms) == {"blur", "latent", "events", "reg"}
    assert "reg" not in model.losses(late, STEPS - 1), "growing has ended"


def test_in_the_end_frames_decide_and_events_no_longer() -> None:
    model = small(
        "ev-splat", sampling=SamplingOptions(edi_phase=0.5, final_event_weight=0.1)
    ).build(recorded(), 0)
    batch, settles = model.draw(STEPS - 1), model.scene.last_growth
    before, first, last = (model.losses(batch, step) for step in (STEPS // 2, settles, STEPS))
    for name in ("latent", "events"):
        torch.testing.assert_close(first[name], before[name])
        torch.testing.assert_close(last[name], 0.1 * first[name])
    torch.testing.assert_close(last["blur"], first["blur"])
    alone = small("event-splat").build(recorded(), 0)
    assert alone.event_decay(STEPS) == 1, "events alone stay what they are"


def test_a_blurred_frame_is_the_mean_of_all_views_with_the_gradient_of_a_few() -> None:
    """Of few views, the error would be that of a frame which was exposed at those few instants."""
    looks = SamplingOptions(
        grad_views=2, views=8, edi_phase=0.0, latent_weight=0.0, event_weight=0.0
    )
    model = small("ev-splat", sampling=looks).build(recorded(), 0)
    batch = model.draw(0)
    look, rest, frames = batch["views"], batch["no_grad_views"], batch["frames"]
    assert isinstance(look, Instants) and isinstance(rest, Instants) and isinstance(frames, Pixels)

    def mean(*looks: Instants) -> torch.Tensor:
        time = torch.cat([look.time for look in looks], 1)
        pose = model.shutter.pose(time, torch.zeros_like(time, dtype=torch.int64))
        corner = torch.zeros(*time.shape, 2, dtype=torch.int64)
        weight = torch.full_like(time, 1 / time.shape[1])
        return mix(model.scene.draw(Views(pose, time, weight, corner, look.size)))

    whole = mean(look, rest).detach().requires_grad_()
    wanted = (model.tone.encode(whole) - frames.value).abs().mean()
    blur = model.losses(batch, 0)["blur"]
    torch.testing.assert_close(blur, wanted)

    colours = model.scene.static.base_harmonics
    pull = (mean(look) * torch.autograd.grad(wanted, whole)[0]).sum()
    for one, other in zip(
        torch.autograd.grad(blur, colours), torch.autograd.grad(pull, colours), strict=True
    ):
        torch.testing.assert_close(one, other)
        assert one.any()


def test_the_baselines_differ_in_how_they_model_frames() -> None:
    plain, edi, blur = (small(name).build(recorded(), 0) for name in NAMES[:3])
    one, other = (model.draw(0)["frames"] for model in (plain, edi))
    assert torch.equal(one.frame, other.frame) and not torch.equal(one.value, other.value)
    assert plain.draw(0)["views"].shape == edi.draw(0)["views"].shape == (1, 1)
    assert blur.draw(0)["views"].shape[1] > 1 and "events" not in blur.draw(0)


def test_event_splat_never_uses_frames() -> None:
    both, alone = (
        small("event-splat").build(capture, 0)
        for capture in (recorded(), recorded().without(frames=True))
    )
    assert set(both.draw(0)) == {"views", "events"}
    assert torch.equal(both.scene.static.means, alone.scene.static.means)


def test_it_is_a_model_that_grows_and_draws_views() -> None:
    model = small("ev-splat").build(recorded(), 0)
    assert isinstance(model, Model) and isinstance(model, Growing)
    assert isinstance(model, ViewRenderer) and renderer_of(model) is model
    pose = model.capture.frame_pose(np.array([0]))[0]
    seen = render_view(renderer_of(model), model.capture.camera, pose, 0.5)
    shown = model.encode(seen.rgb)
    assert shown.shape == (24, 32, 3) and shown.min() >= 0 and shown.max() <= 1


def test_scattered_rays_are_refused() -> None:
    model, rows = small("splat").build(recorded(), 0), torch.zeros(5, 3)
    with pytest.raises(OptionError) as refused:
        model.render(Rays(rows, rows, rows[:, 0], rows[:, 0]))
    assert str(refused.value) == (
        "OptionError: a scene of Gaussians renders whole views, not scattered rays\n"
        "  got    5 rays\n"
        "  do     call draw_views"
    )


LENSES = {"brown": (-0.3, 0.08, 0.002, -0.002, 0.0), "fisheye": (-0.02, 0.005, 0.0, 0.0)}


@pytest.mark.parametrize("lens", LENSES)
def test_a_distorted_lens_is_learned_through(lens: str) -> None:
    """All of the image is drawn, as recorded: no pixel is left without a view."""
    rig = Rig((32, 24), lens=lens, distortion=LENSES[lens])
    timing = Timing(frames=6, exposure_us=20_000, interval_us=24_000, test_every=4)
    capture = simulate("tiles", rig=rig, timing=timing, seed=3)
    model = small("ev-splat").build(capture, 0)
    before, after = learned(model)
    assert after < 0.8 * before
    pose = model.capture.frame_pose(np.array([0]))[0]
    seen = render_view(renderer_of(model), model.capture.camera, pose, 0.5)
    assert seen.shape == (24, 32) and seen.opacity.min() > 0.05
    other = model.through(replace(capture.camera, lens="pinhole", distortion=()))
    straight = render_view(other, other.camera, pose, 0.5)
    assert straight.shape == (24, 32) and (straight.rgb - seen.rgb).abs().mean() > 1e-3


def test_a_lens_that_sees_too_wide_is_refused() -> None:
    fish = Camera(32, 24, 9.0, 9.0, 16.0, 12.0, "fisheye", (0.0, 0.0, 0.0, 0.0))
    model = small("splat").build(replace(recorded(), camera=fish), 0)
    with pytest.raises(OptionError, match="the field of view is too wide"):
        model.losses(model.draw(0), 0)


@functools.cache
def rolled() -> Capture:
    """A shaky camera that takes a tenth of a second to read an image."""
    rig = Rig((36, 30), frame_sensor=FrameSensor(row_delay_us=3500.0))
    timing = Timing(frames=9, exposure_us=10_000, interval_us=120_000, test_every=4)
    return simulate("tiles", "shaky", rig=rig, timing=timing, seed=5)


def test_a_rolling_shutter_is_better_modelled_than_not() -> None:
    """Sharp images are more like views whose rows are read late than like those of an instant."""
    model = replace(small("ev-splat"), steps=100).build(rolled(), 0)
    fit(model, adam(model), steps=range(100))
    frames = rolled().needed_frames
    assert frames.truth is not None
    shutter, off = Rolling.of(rolled(), along=model.path), []
    for frame, sharp in enumerate(frames.truth):
        time = model.capture.frame_time[frame].mean()
        pose, late = (ask(time, torch.tensor(0)) for ask in (shutter.pose, shutter.rows))
        seen = [
            render_view(model, model.capture.camera, pose, float(time), rows=rows).rgb
            for rows in (late, None)
        ]
        truth = torch.from_numpy(sharp / np.float32(frames.white))
        off.append([(model.encode(light) - truth).square().mean() for light in seen])
    modelled, ignored = torch.tensor(off).mean(0)
    assert modelled < 0.98 * ignored


@pytest.mark.parametrize("name", NAMES)
def test_every_recipe_learns_through_a_rolling_shutter(name: str) -> None:
    before, after = learned(replace(small(name), steps=2 * STEPS).build(rolled(), 0))
    assert after < 0.9 * before


@pytest.mark.parametrize(
    ("name", "missing", "message"),
    [
        ("splat", "frames", "learns from frames"),
        ("blur-splat", "frames", "learns from frames"),
        ("edi-splat", "frames", "this needs frames"),
        ("edi-splat", "events", "this needs events"),
        ("event-splat", "events", "this needs events"),
    ],
)
def test_what_a_recipe_needs_is_said(name: str, missing: str, message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        small(name).build(recorded().without(**{missing: True}), 0)


def test_the_recipes_are_listed_and_described() -> None:
    for name in NAMES:
        recipe = RECIPES[name]
        assert recipe.__doc__ and recipe.paper.bibtex.startswith("@")
        assert recipe().lasting(9).steps == 9
    assert len({RECIPES[name].__doc__ for name in NAMES}) == len(NAMES)


def test_a_step_depends_on_seed_and_step_alone() -> None:
    recipe = small("ev-splat", calibration=LearnedCalibrationOptions(gains=True, knots=4))
    first, second = recipe.build(recorded(), 5), recipe.build(recorded(), 5)
    first.losses(first.draw(3), 3)  # what was sampled before does not matter
    for step in (2, 20):
        one, other = (model.losses(model.draw(step), step) for model in (first, second))
        assert one.keys() == other.keys()
        assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    ("name", "growth", "source"),
    [
        ("ev-splat", "mcmc", recorded),
        ("splat", "densify", recorded),
        ("blur-splat", "mcmc", photos),
    ],
)
def test_resuming_equals_never_having_stopped(
    tmp_path: Path, name: str, growth: str, source: Any
) -> None:
    gaussians = GaussianOptions(cap_max=600, start=0.5, growth=growth, grow_every=4)
    unknowns = LearnedCalibrationOptions(
        thresholds="signs", gains=True, knots=4, offset=name == "ev-splat"
    )
    recipe, stop_at = small(name, gaussians=gaussians, calibration=unknowns), 18

    class Dying(SplatModel):
        def draw(self, step: int) -> Any:
            if step == stop_at:
                raise KeyboardInterrupt
            return super().draw(step)

    def dying(steps: int) -> SplatModel:
        model = recipe.build(source(), 1)
        model.__class__ = Dying
        return model

    def go(folder: str, build: Any, *, resume: bool = False) -> bytes:
        options = TrainingOptions(checkpoint_every=5, resume=resume)
        train(build, tmp_path / folder, options, steps=STEPS, settings={}, console=quiet())
        return file_of(tmp_path / folder, "last").read_bytes()

    straight = go("straight", lambda steps: recipe.build(source(), 1))
    with pytest.raises(KeyboardInterrupt):
        go("stopped", dying)
    assert go("stopped", lambda steps: recipe.build(source(), 1), resume=True) == straight


def test_a_scene_can_be_seen_through_another_lens() -> None:
    model = small("splat").build(recorded(), 0)
    camera, pose = model.capture.camera, model.capture.frame_pose(np.array([2]))[0]
    own = render_view(renderer_of(model), camera, pose, 0.5)
    same = render_view(model.through(camera), camera, pose, 0.5)
    assert torch.equal(own.rgb, same.rgb)
    large = camera.scaled(3.0)
    seen = render_view(model.through(large), large, pose, 0.5).rgb
    assert seen.shape == (72, 96, 3)
    downscaled = seen.reshape(24, 3, 32, 3, 3).mean((1, 3))
    assert (downscaled - own.rgb).abs().mean() < 0.2 * (own.rgb - own.rgb.mean()).abs().mean()


@pytest.mark.parametrize("name", ["edi-splat", "ev-splat"])
def test_events_of_several_cameras_are_learned_from(name: str):
    before, after = learned(replace(small(name), steps=2 * STEPS).build(tiny_moving(30_000), 0))
    assert after < 0.9 * before


def test_sharp_frames_of_a_rig_need_no_events_to_start_from():
    before, after = learned(small("splat").build(tiny_moving(), 0))
    assert after < 0.8 * before
