"""What one engine gives to static and moving scenes alike: shutters, lenses, crops, depth, ..."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.frames import DepthMaps
from sharpfield.core.measurements import EventPairs
from sharpfield.core.rays import Views
from sharpfield.evaluation.event_scores import HasLogLight
from sharpfield.geometry.rolling import Rolling
from sharpfield.recipes import recipe_named
from sharpfield.recipes.splats.learned_calibration import LearnedCalibrationOptions
from sharpfield.recipes.splats.model import SplatModel
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from tests.recipes.moving import tiny_moving

NAMES = ("ev-splat", "ev-dynamic-splat")
STEPS = 20


def blurred() -> Capture:
    return tiny_moving(30_000)


def rolled() -> Capture:
    """A capture whose rows are read one after the other, for as long as it takes 1 ms each."""
    frames = blurred().needed_frames
    exposure = replace(frames.exposure, row_delay_us=1000.0)
    return replace(blurred(), frames=replace(frames, exposure=exposure))


def distorted() -> Capture:
    camera = replace(blurred().camera, lens="brown", distortion=(-0.1, 0.02, 0.0, 0.0, 0.0))
    return replace(blurred(), camera=camera)


def with_depth() -> Capture:
    capture = blurred()
    frames = capture.needed_frames
    shape = len(frames), *capture.camera.size[::-1]
    stored = np.full(shape, round((capture.near + capture.far) / 2 * 1000), np.uint16)
    return replace(capture, depth=DepthMaps(stored, capture.camera))


def model(name: str, capture: Capture, **changes: Any) -> SplatModel:
    """A small model; changes are made to its `sampling`, or replace its `calibration`."""
    recipe = replace(recipe_named(name)(), steps=STEPS)
    calibration = changes.pop("calibration", recipe.calibration)
    growth = changes.pop("growth", "mcmc")
    return replace(
        recipe,
        gaussians=replace(recipe.gaussians, cap_max=400, grow_every=5, growth=growth),
        sampling=replace(recipe.sampling, **changes),
        calibration=calibration,
    ).build(capture, 0)


def trained(made: SplatModel) -> SplatModel:
    fit(made, adam(made), steps=range(STEPS))
    assert all(torch.isfinite(parameter).all() for parameter in made.parameters())
    return made


@pytest.mark.parametrize("capture", [blurred, rolled, distorted, with_depth])
@pytest.mark.parametrize("name", NAMES)
def test_every_kind_of_capture_is_learned_from(name: str, capture: Any):
    made = model(name, capture(), depth_weight=0.1)
    batch = made.draw(STEPS - 1)
    terms = made.losses(batch, STEPS - 1)
    assert {"blur", "latent", "events"} <= terms.keys()
    assert ("depth" in terms) == (capture is with_depth)
    sum(terms.values()).backward()
    for own in (made.scene.static, made.scene.moving):
        assert own is None or own.means.grad.abs().sum() > 0
    trained(made)


@pytest.mark.parametrize("name", NAMES)
def test_a_crop_is_a_part_of_the_whole(name: str):
    whole, cut = (model(name, blurred(), crop=crop) for crop in (0, 6))
    batch = cut.draw(STEPS - 1)
    assert batch["views"].size == (6, 6) and batch["frames"].shape[1:] == (6, 6)
    assert batch["events"].shape[2:4] == batch["latent_frames"].shape[1:3] == (6, 6)
    views = cut.exposure.expose(batch["views"])
    left, top = views.corner[0, 0].tolist()
    every = replace(views, corner=torch.zeros_like(views.corner), size=(16, 16))
    with torch.no_grad():
        part, full = cut.scene.draw(views).rgb, whole.scene.draw(every).rgb
    torch.testing.assert_close(part, full[:, top : top + 6, left : left + 6], atol=1e-5, rtol=1e-4)
    trained(cut)


@pytest.mark.parametrize("name", NAMES)
def test_frames_are_drawn_by_their_quality(name: str):
    made = model(name, blurred(), frame_quality="images", edi_phase=0.0)
    weights = made.sampler.weights
    assert weights is not None and len(weights) == len(made.capture.split.train)
    assert made.draw(STEPS - 1)["frames"].shape[0] == made.sampling.cameras


@pytest.mark.parametrize("growth", ["densify", "none"])
@pytest.mark.parametrize("name", NAMES)
def test_every_way_of_growing_works(name: str, growth: str):
    made = trained(model(name, blurred(), growth=growth))
    assert "reg" not in made.losses(made.draw(0), 0)
    if growth == "densify":
        stats = {name: own.stats.mean_grad for name, own in made.scene.strategies.items()}
        assert stats.keys() == {"static", "moving"} & {"static", *_moving(made)}
        assert all(grad.any() for grad in stats.values())


def _moving(made: SplatModel) -> tuple[str, ...]:
    return () if made.scene.moving is None else ("moving",)


@pytest.mark.parametrize("name", NAMES)
def test_the_whole_calibration_is_learned_at_once(name: str):
    calibration = LearnedCalibrationOptions(
        thresholds="pixels", response="residual", gains=True, knots=5, offset=True
    )
    made = trained(model(name, rolled(), calibration=calibration, edi_phase=0.2))
    learned = (*made.calibration.named_parameters(), *made.path.named_parameters())
    assert all(parameter.any() for _, parameter in learned)


@pytest.mark.parametrize("name", NAMES)
def test_to_refine_a_camera_frames_and_events_take_turns(name: str):
    """Views at the instants of frames cannot tell by how much the events' clock is late."""
    recipe = replace(recipe_named(name)(), steps=STEPS)
    made = recipe.presets.apply(["refine"], recipe).build(blurred(), 0)
    late = range(made.heaviest_step, STEPS)
    kinds = {step: "frames" if "frames" in made.draw(step) else "events" for step in late}
    assert set(kinds.values()) == {"frames", "events"}
    assert all(("events" in made.draw(step)) == (kinds[step] == "events") for step in late)
    made.losses(made.draw(STEPS - 1), STEPS - 1)["events"].backward()
    # Cameras that do not move see a static scene alike at all times.
    assert bool(made.calibration.offset_steps.grad.any()) == (made.scene.moving is not None)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("response", ["fixed", "residual"])
def test_log_light_is_what_events_are_compared_with(name: str, response: str):
    """Event scores of every recipe use the floor and the response that it was trained with."""
    calibration = LearnedCalibrationOptions(response=response, floor=0.01)
    made = model(name, blurred(), calibration=calibration)
    if response == "residual":
        made.calibration.response.heights.data += 0.1
    assert isinstance(made, HasLogLight)
    light = torch.rand(4, 5, 3)
    zeros = torch.zeros(20)
    pixel = EventPairs(zeros[:, None].expand(-1, 2), zeros.long(), zeros, zeros, zeros, zeros)
    wanted = made.calibration.response(light.view(20, 1, 3), pixel).view(4, 5)
    torch.testing.assert_close(made.log_light(light), wanted)
    if response == "fixed":
        luma = (light * torch.tensor([0.299, 0.587, 0.114])).sum(-1)
        torch.testing.assert_close(made.log_light(light), (luma + 0.01).log())


@pytest.mark.parametrize("noted", [None, 0.003])
def test_the_floor_of_the_capture_is_used_if_asked_for(noted: float | None):
    capture = replace(blurred(), known=replace(blurred().known, log_floor=noted))
    made = model("ev-splat", capture, calibration=LearnedCalibrationOptions(floor=None))
    dark = torch.zeros(1, 3)
    assert made.log_light(dark).exp().item() == pytest.approx(noted or 1e-4, rel=1e-4)


def test_moving_gaussians_are_where_they_are_when_their_row_is_read():
    """Oracle: render the moving scene once for each row, at the time that row is read."""
    made = model("ev-dynamic-splat", rolled(), latent_weight=0.0)
    moving, delay = made.scene.moving, 1000 / made.capture.clock.span_us
    assert moving is not None
    with torch.no_grad():
        moving.velocities[:, 0] = 6.0  # several pixels while an image is read
        moving.opacity_logits += 3
        moving.log_scales -= 0.7  # what is large is sheared, too, which is not modelled
    shutter, time = Rolling.of(made.capture), torch.tensor([[0.4]])
    track = torch.zeros(1, 1, dtype=torch.int64)
    corner = torch.zeros(1, 1, 2, dtype=torch.int64)

    def shown(time: torch.Tensor, rows: torch.Tensor | None) -> torch.Tensor:
        pose = made.path.pose(time, track)
        views = Views(pose, time, torch.ones(1, 1), corner, (16, 16), rows)
        with torch.no_grad():
            return made.draw_views(views).rgb[0, :, :, 0]

    wanted = torch.stack([shown(time + (row + 0.5) * delay, None)[row] for row in range(16)])
    modelled = shown(time, shutter.rows(time, track))
    ignored = shown(time + shutter.readout / 2, None)
    off, before = (float((seen - wanted).abs().mean()) for seen in (modelled, ignored))
    assert off < 0.5 * before
