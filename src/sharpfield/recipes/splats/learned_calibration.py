"""Learned calibration: thresholds, response, exposure gains, poses, and the clocks' offset.

Each is fixed at what the capture says, or learned from there together with the scene.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import EventPairs
from sharpfield.core.protocols import Response
from sharpfield.core.schedule import Group, Schedule, constant, exponential
from sharpfield.core.seed import generator
from sharpfield.events.latent_frames import SensorEstimate
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds, thresholds_of
from sharpfield.formation.response import FixedResponse, LogResidual
from sharpfield.geometry.trajectory import LearnedExposureMotion, LearnedKnots

VIRTUAL_SHUTTER = 0.5
"""Assumed exposure of photos of unknown motion, as a fraction of the time between them. It does not
matter, as their motion is only ever evaluated within the exposure."""

MOTION_KNOTS = 4
"""Knots of the motion learned for each such photo."""
FIRST_TWIST = 1e-3
"""Size of the first random twists, in rad and units of the normalised scene."""

FLOOR = 1e-4
"""Linear light added before the logarithm of what events see."""

OFFSET_UNIT_US = 1000.0
"""The offset is learned in this unit, so that one learning rate suits it."""

OFFSET_STEP_US, THRESHOLD_STEP = 50, 0.01
"""Steps in which the sensor estimate changes, in us and in natural log."""

GAIN_PRIOR = 1.0
"""Weight of the squared mean log gain, which the scene's own brightness could take up."""


@dataclass(frozen=True)
class LearnedCalibrationOptions:
    """Which parts of the calibration are learned together with the scene, and how fast."""

    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter to start from, natural log; None takes those of
    the capture, or 0.2."""
    thresholds: Literal["fixed", "signs", "pixels"] = "fixed"
    """`signs` learns a factor on the threshold of each polarity, `pixels` also one for each
    pixel."""
    floor: float | None = 1e-4
    """Linear light added before the logarithm of what events see; None takes that of the capture,
    or 1e-4."""
    response: Literal["fixed", "residual"] = "fixed"
    """`fixed`: events follow log light; `residual`: plus a learned function of it, zero at
    first."""
    gains: bool = False
    """Learn an exposure gain for each frame."""
    knots: int = 0
    """Knots of a learned correction of the trajectory, a cubic B-spline, at least 4; 0 keeps the
    poses."""
    offset: bool = False
    """Learn by how much the events' clock is late against that of frames and poses."""
    lr: float = 2e-3
    """Learning rate of thresholds, response and gains (all logarithms). It falls to a twentieth,
    but for the thresholds of the polarities."""
    poses_lr: float = 3e-4
    """Learning rate of the trajectory's correction, in rad and units of the normalised scene."""
    offset_lr_us: float = 60.0
    """Learning rate of the offset, in us a step."""


class LearnedCalibration(nn.Module):
    """The calibration of one capture, partly learned.

    Args:
        options: Which parts are learned.
        capture: In its normalised space.
        seed: Of the run.
    """

    def __init__(self, options: LearnedCalibrationOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.clock = options, capture.clock
        self.first_thresholds = thresholds_of(capture, options.threshold)
        if options.thresholds == "fixed":
            self.thresholds = FixedThresholds(*self.first_thresholds)
        else:
            pixels = capture.camera.size if options.thresholds == "pixels" else None
            self.thresholds = LearnedThresholds(*self.first_thresholds, pixels=pixels)
        floor = options.floor or capture.known.log_floor or FLOOR
        self.response: Response = FixedResponse(floor=floor)
        if options.response == "residual":
            made = generator(seed, 0, "response")
            self.response = LogResidual(inputs="light", floor=floor, generator=made)
        frames = 0 if capture.frames is None else len(capture.frames)
        self.log_gain = nn.Parameter(torch.zeros(frames)) if options.gains and frames else None
        self.offset_steps = nn.Parameter(torch.zeros(())) if options.offset else None

    @property
    def offset_us(self) -> float:
        """By how much the events' clock is late."""
        if self.offset_steps is None:
            return 0.0
        return float(self.offset_steps.detach()) * OFFSET_UNIT_US

    @property
    def learns_thresholds(self) -> bool:
        """Whether thresholds are learned."""
        return isinstance(self.thresholds, LearnedThresholds)

    def threshold_pair(self) -> tuple[float, float]:
        """The thresholds to darker and to brighter, without the factors of single pixels."""
        if isinstance(self.thresholds, FixedThresholds):
            return self.first_thresholds
        negative, positive = (self.thresholds.log_guess + self.thresholds.log_factor).exp().tolist()
        return negative, positive

    def sensor_estimate(self) -> SensorEstimate:
        """What is known of the event camera by now, quantised.

        Latent frames made with it are cached; so it changes in steps, too small to matter.
        """
        negative, positive = (
            math.exp(round(math.log(c) / THRESHOLD_STEP) * THRESHOLD_STEP)
            for c in self.threshold_pair()
        )
        late = round(self.offset_us / OFFSET_STEP_US) * OFFSET_STEP_US
        if isinstance(self.thresholds, FixedThresholds):
            negative, positive = self.first_thresholds
        return SensorEstimate(negative, positive, late)

    def corrected_time(self, time: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Times of the events' clock on that of the frames, both 0...1 of the capture."""
        if self.offset_steps is None:
            return time
        return time - self.offset_steps * (OFFSET_UNIT_US / self.clock.span_us)

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """What a mono pixel reports of linear light, natural log."""
        flat = light.reshape(-1, 1, light.shape[-1])  # [n, 1, c]
        zeros = flat.new_zeros(len(flat))
        pixel = EventPairs(zeros[:, None].expand(-1, 2), zeros.long(), *[zeros] * 4)
        return self.response(flat, pixel).reshape(light.shape[:-1])

    def prior(self) -> Float[Tensor, ""] | None:
        """Keeps pixel thresholds and the mean gain near their start; None if neither is learned."""
        terms = []
        if isinstance(self.thresholds, LearnedThresholds) and self.thresholds.log_pixel is not None:
            terms.append(self.thresholds.prior())
        if self.log_gain is not None:
            terms.append(self.log_gain.mean().square() * GAIN_PRIOR)
        return torch.stack(terms).sum() if terms else None

    def groups(self, steps: int) -> list[Group]:
        """Parameters with their learning rates, over a schedule of so many steps."""
        options, own = self.options, self.thresholds
        offset = [] if self.offset_steps is None else [self.offset_steps]
        # What these two numbers learn is as good as the scene, which is best at the end.
        signs = [own.log_factor] if isinstance(own, LearnedThresholds) else []
        alone = {id(p) for p in (*offset, *signs)}
        others = [p for p in self.parameters() if id(p) not in alone]
        found = [
            ("calibration", others, falling(options.lr, steps)),
            ("thresholds", signs, constant(options.lr)),
            ("offset", offset, falling(options.offset_lr_us / OFFSET_UNIT_US, steps)),
        ]
        return [Group(name, tuple(own), rate) for name, own, rate in found if own]


def falling(rate: float, steps: int) -> Schedule:
    """A learning rate that falls to a twentieth over a schedule."""
    return exponential(rate, rate / 20, until=steps)


def with_learned_poses(capture: Capture, options: LearnedCalibrationOptions) -> Capture:
    """The capture with a learned correction of its trajectory, if `knots` asks for one."""
    if options.knots == 0:
        return capture
    frames, events = capture.frames, capture.events
    tracks = max(
        1 if frames is None else int(frames.track.max()) + 1, 1 if events is None else events.tracks
    )
    path = LearnedKnots(capture.trajectory, knots=options.knots, tracks=tracks)
    return replace(capture, trajectory=path)


def with_learned_exposure_motion(capture: Capture, seed: int) -> Capture:
    """Photos of unknown motion as exposures with a learned motion each."""
    frames = capture.needed_frames
    middle = frames.exposure.middle_us
    gap = int(np.diff(np.sort(middle)).min()) if len(middle) > 1 else capture.clock.span_us
    half = max(int(gap * VIRTUAL_SHUTTER / 2), 1)
    exposure = replace(frames.exposure, open_us=middle - half, close_us=middle + half)
    opens, closes = (
        torch.from_numpy(capture.clock.unit(t)).float()
        for t in (exposure.open_us, exposure.close_us)
    )
    start = torch.zeros(len(frames), MOTION_KNOTS, 6)
    made = generator(seed, 0, "shake")
    learned = torch.from_numpy(capture.split.train)
    start[learned] = FIRST_TWIST * torch.randn(len(learned), MOTION_KNOTS, 6, generator=made)
    by_track = torch.from_numpy(frames.track)
    path = LearnedExposureMotion(
        capture.trajectory,
        opens[by_track.argsort()],
        closes[by_track.argsort()],
        knots=MOTION_KNOTS,
        start=start[by_track.argsort()],
    )
    return replace(capture, trajectory=path, frames=replace(frames, exposure=exposure))


def pose_groups(capture: Capture, rate: Schedule) -> list[Group]:
    """Learned parameters of the trajectory, as a group with its learning rate."""
    path = capture.trajectory
    learned = path.parameters() if isinstance(path, LearnedKnots | LearnedExposureMotion) else ()
    own = tuple(p for p in learned if p.requires_grad)
    return [Group("poses", own, rate)] if own else []
