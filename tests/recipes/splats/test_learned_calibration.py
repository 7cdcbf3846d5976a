"""What real cameras do not tell: nothing at first, and learned in the right direction."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sharpfield.core.capture import Capture, Known, Thresholds
from sharpfield.core.measurements import Batch, EventPairs, Instants, Pixels
from sharpfield.core.rays import Radiance, Views
from sharpfield.events.threshold import LearnedThresholds
from sharpfield.formation.mixing import mix
from sharpfield.geometry.trajectory import LearnedExposureMotion, LearnedKnots, Still
from sharpfield.recipes.splat import EvSplat
from sharpfield.recipes.splats.learned_calibration import (
    OFFSET_UNIT_US,
    LearnedCalibration,
    LearnedCalibrationOptions,
    pose_groups,
    with_learned_exposure_motion,
    with_learned_poses,
)
from sharpfield.recipes.splats.model import SplatModel
from sharpfield.recipes.splats.scene import GaussianOptions
from sharpfield.sampling.views import SamplingOptions

ALL = LearnedCalibrationOptions(
    threshold=(0.3, 0.1), thresholds="pixels", response="residual", gains=True, knots=5, offset=True
)
NONE = LearnedCalibrationOptions(threshold=(0.3, 0.1))


def model(capture: Capture, calibration: LearnedCalibrationOptions, **looks) -> SplatModel:
    recipe = EvSplat(
        steps=100,
        gaussians=GaussianOptions(cap_max=300, growth="none"),
        sampling=SamplingOptions(edi_phase=0.0, **looks),
        calibration=calibration,
    )
    return recipe.build(capture, 0)


def total(terms: dict[str, Tensor]) -> Tensor:
    return torch.stack(list(terms.values())).sum()


def batches(made: SplatModel) -> list[Batch]:
    return [
        made.sampler.exposure_batch(2, made.calibration.sensor_estimate(), events=True),
        made.sampler.event_batch(3),
    ]


def test_at_first_what_is_learned_does_nothing(tiny: Capture):
    learned, fixed = model(tiny, ALL), model(tiny, NONE)
    for batch in batches(fixed):
        one, other = (made.losses(batch, 0) for made in (learned, fixed))
        assert one.keys() - other.keys() == {"prior", "thresholds"}
        assert float(one["prior"].detach()) == 0
        for name, wanted in other.items():
            torch.testing.assert_close(one[name], wanted, rtol=1e-5, atol=1e-8, msg=name)
    time, track = torch.linspace(0, 1, 7), torch.zeros(7, dtype=torch.int64)
    torch.testing.assert_close(learned.path.pose(time, track), fixed.path.pose(time, track))
    assert (
        torch.equal(learned.calibration.corrected_time(time), time)
        and learned.calibration.offset_us == 0
    )
    assert learned.calibration.first_thresholds == fixed.calibration.first_thresholds == (0.3, 0.1)


def test_everything_that_is_unknown_is_asked(tiny: Capture):
    made = model(tiny, ALL)
    for batch in batches(made):
        total(made.losses(batch, 0)).backward()
    for name, parameter in (*made.calibration.named_parameters(), *made.path.named_parameters()):
        # Steps of the response get gradients once their heights are not zero.
        asked = parameter.grad is not None and bool(parameter.grad.any())
        assert asked or ".steps." in name, name


def test_groups_hold_all_of_them_once_at_their_rates(tiny: Capture):
    made = model(tiny, replace(ALL, lr=0.5, poses_lr=0.25, offset_lr_us=40.0))
    groups = {group.name: group for group in made.groups()}
    assert groups["calibration"].rate(0) == 0.5 and groups["poses"].rate(0) == 0.25
    assert groups["offset"].rate(0) == 40.0 / OFFSET_UNIT_US
    assert groups["thresholds"].rate(100) == 0.5 and len(groups["thresholds"].parameters) == 1
    assert groups["poses"].rate(100) == pytest.approx(0.25 / 20)
    listed = [id(p) for group in groups.values() for p in group.parameters]
    assert len(listed) == len(set(listed)) and set(listed) == {id(p) for p in made.parameters()}
    plain = {group.name for group in model(tiny, NONE).groups()}
    assert plain.isdisjoint({"calibration", "thresholds", "offset", "poses"})


def test_a_late_clock_is_found_in_the_right_direction(tiny: Capture):
    """Events that are late ask for a larger offset, early ones for a smaller."""
    truth = light_of(model(tiny, replace(NONE, offset=True)))
    for late_us, sign in ((4_000, 1), (-4_000, -1)):
        made = model(tiny, replace(NONE, offset=True))
        offset = made.calibration.offset_steps
        assert offset is not None
        grow = sum(slope_of(made, truth, offset, late_us, step) for step in range(4))
        assert float(grow) * sign < 0, "going down the slope goes towards the truth"


def light_of(made: SplatModel) -> SplatModel:
    """A model with colours of strong contrast, to be recorded by made-up events."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        own = made.scene.static
        own.base_harmonics += 1.5 * torch.randn(own.base_harmonics.shape, generator=generator)
        own.opacity_logits += 3
    return made


def seen_by(made: SplatModel, look: Instants, late_us: float = 0) -> Radiance:
    """The views of a look, as they were when events that are late happened."""
    time = look.time - late_us / made.capture.clock.span_us
    views = Views(made.path.pose(time, look.track), time, look.weight, look.corner, look.size)
    with torch.no_grad():
        return made.scene.draw(views)


def slope_of(
    made: SplatModel, truth: SplatModel, learned: Tensor, late_us: float, step: int
) -> Tensor:
    """Gradient for one parameter on events that a sensor of 0.3 and 0.1 reports of the truth."""
    made.scene.load_state_dict(truth.scene.state_dict())
    batch = made.sampler.event_batch(step)
    look, events = batch["views"], batch["events"]
    assert isinstance(look, Instants) and isinstance(events, EventPairs)
    rgb = seen_by(truth, look, late_us).rgb[0].flatten(0, 1)
    log = truth.calibration.response(rgb, events[0, 0].reshape(-1))[..., 0]
    change = (log[:, 1:] - log[:, :-1]).T.reshape(events.shape)
    negative, positive = change.clamp(max=0) / 0.3, change.clamp(min=0) / 0.1
    exact = torch.zeros_like(positive)
    batch["events"] = replace(events, negative=negative, positive=positive, slack=exact)
    return torch.autograd.grad(total(made.losses(batch, step)), learned)[0]


def test_thresholds_go_towards_those_of_the_sensor(tiny: Capture):
    """Events of a sensor with larger thresholds than the guess ask for larger ones."""
    truth = light_of(model(tiny, NONE))
    for guess, sign in (((0.2, 0.07), 1), ((0.4, 0.14), -1)):
        made = model(tiny, LearnedCalibrationOptions(threshold=guess, thresholds="signs"))
        thresholds = made.calibration.thresholds
        assert isinstance(thresholds, LearnedThresholds)
        slope = sum(slope_of(made, truth, thresholds.log_factor, 0, step) for step in range(6))
        assert (torch.as_tensor(slope) * sign < 0).all()


def test_knots_go_back_to_where_the_camera_was(tiny: Capture):
    truth = light_of(model(tiny, NONE))
    for axis in range(6):
        made = model(tiny, replace(NONE, knots=4))
        assert isinstance(made.path, LearnedKnots)
        made.scene.load_state_dict(truth.scene.state_dict())
        moved = torch.zeros(6)
        moved[axis] = 0.02
        with torch.no_grad():
            made.path.twist += moved
        batch = blurred(
            truth, made.sampler.exposure_batch(1, made.calibration.sensor_estimate(), events=False)
        )
        slope = torch.autograd.grad(made.losses(batch, 0)["blur"], made.path.twist)[0]
        assert slope.sum((0, 1))[axis] > 0, "going down the slope undoes the move"


def blurred(truth: SplatModel, batch: Batch, *, gain: float = 1.0) -> Batch:
    """The look with the frame that a model predicts."""
    look, frames = batch["views"], batch["frames"]
    assert isinstance(look, Instants) and isinstance(frames, Pixels)
    value = mix(seen_by(truth, look), outer=truth.tone.encode)
    return {**batch, "frames": replace(frames, value=gain * value)}


def test_a_brighter_exposure_asks_for_a_larger_gain(tiny: Capture):
    truth = light_of(model(tiny, NONE))
    made = model(tiny, replace(NONE, gains=True))
    made.scene.load_state_dict(truth.scene.state_dict())
    gains = made.calibration.log_gain
    assert gains is not None and len(gains) == len(tiny.needed_frames)
    for factor, sign in ((1.2, 1), (0.8, -1)):
        batch = blurred(
            truth,
            made.sampler.exposure_batch(1, made.calibration.sensor_estimate(), events=False),
            gain=factor,
        )
        frame = int(batch["frames"].frame[0, 0, 0])
        slope = torch.autograd.grad(made.losses(batch, 0)["blur"], gains)[0]
        assert slope[frame] * sign < 0 and (slope != 0).sum() == 1


def test_gains_can_not_all_rise_together(tiny: Capture):
    calibration = LearnedCalibration(LearnedCalibrationOptions(gains=True), tiny, 0)
    assert calibration.log_gain is not None and calibration.prior() is not None
    calibration.log_gain.data += torch.tensor([0.3, -0.3] * 3)
    assert float(calibration.prior().detach()) == pytest.approx(0, abs=1e-12)
    calibration.log_gain.data += 0.3
    assert float(calibration.prior().detach()) == pytest.approx(0.09)


def test_what_is_known_needs_no_prior(tiny: Capture):
    assert LearnedCalibration(NONE, tiny, 0).prior() is None
    assert not list(LearnedCalibration(NONE, tiny, 0).parameters())


def test_thresholds_come_from_the_capture_unless_given(tiny: Capture):
    noted = replace(tiny, known=Known(thresholds=Thresholds(0.31, 0.17)))
    assert LearnedCalibration(LearnedCalibrationOptions(), noted, 0).first_thresholds == (
        0.31,
        0.17,
    )
    assert LearnedCalibration(NONE, noted, 0).first_thresholds == (0.3, 0.1)


def test_an_offset_is_in_microseconds_of_the_events_clock(tiny: Capture):
    calibration = LearnedCalibration(LearnedCalibrationOptions(offset=True), tiny, 0)
    assert calibration.offset_steps is not None
    calibration.offset_steps.data += 2.5
    assert calibration.offset_us == 2500
    time = torch.tensor([0.5])
    early = (time - calibration.corrected_time(time)) * tiny.clock.span_us
    assert early.item() == pytest.approx(2500, rel=1e-4)


def test_poses_are_believed_unless_knots_are_asked_for(tiny: Capture):
    assert with_learned_poses(tiny, NONE) is tiny and not pose_groups(tiny, lambda step: 1.0)
    made = with_learned_poses(tiny, replace(NONE, knots=6))
    (group,) = pose_groups(made, lambda step: 1.0)
    assert group.name == "poses" and [p.shape for p in group.parameters] == [(1, 6, 6)]


def test_photos_of_unknown_motion_get_a_motion_each(tiny: Capture):
    """Those held out stand still; all begin where they were taken, as good as."""
    poses = tiny.frame_pose(np.arange(6)).double().numpy()
    frames = replace(tiny.needed_frames, track=np.arange(6))  # as readers of photos make it
    photos = replace(tiny, trajectory=Still(poses), frames=frames)
    made = with_learned_exposure_motion(photos, 0)
    assert isinstance(made.trajectory, LearnedExposureMotion)
    exposure = made.needed_frames.exposure
    assert (exposure.duration_us > 0).all()
    assert np.abs(exposure.middle_us - frames.exposure.middle_us).max() <= 1
    twist = made.trajectory.twist.detach()
    moves = twist.abs().amax((1, 2)) > 0
    assert moves.tolist() == [i in photos.split.train for i in range(6)]
    assert 0 < twist.abs().max() < 0.01
