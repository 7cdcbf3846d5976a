"""What real cameras do not tell: thresholds, exposure gains, poses, a time offset.

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
from sharpfield.core.protocols import Response
from sharpfield.core.schedule import Group, Schedule, constant, exponential
from sharpfield.core.seed import generator
from sharpfield.events.latent_frames import SensorEstimate
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds, thresholds_of
from sharpfield.formation.response import FixedResponse, LogResidual
from sharpfield.geometry.trajectory import LearnedExposureMotion, LearnedKnots

VIRTUAL_SHUTTER = 0.5
"""Part of the time between photos of unknown motion for which their shutters are taken as open;
the length does not matter, as only places within the exposure are asked for."""

SHAKE_KNOTS = 4
FIRST_SHAKE = 1e-3
"""Size of the first random twists, in rad and units of the normalised scene."""


@dataclass(frozen=True)
class LearnedCalibrationOptions:
    """What is learned besides the scene, and how fast."""

    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter to start from; None takes what the capture
    notes, or 0.2."""
    thresholds: Literal["fixed", "signs", "pixels"] = "fixed"
    """Learn a factor for each sign, or for each sign and pixel."""
    response: Literal["fixed", "residual"] = "fixed"
    """Events follow log light, or log light plus a learned residual that starts at zero."""
    gains: bool = False
    """Learn how bright each frame was exposed."""
    knots: int = 0
    """Knots of a learned correction of the trajectory, at least 4; 0 believes the poses."""
    offset: bool = False
    """Learn by how much the events' clock is late against the frames' and poses'."""
    rate: float = 2e-3
    """Learning rate of thresholds, response and gains (all logarithms); that of the thresholds of
    the signs does not fall."""
    poses_rate: float = 3e-4
    """Of twists, in rad and units of the normalised scene."""
    offset_rate_us: float = 60.0
    """Of the offset, in us a step."""


class LearnedCalibration(nn.Module):
    """The unknowns of one capture.

    Args:
        options: Which are learned.
        capture: In its normalised space.
        seed: Of the run.
    """

    def __init__(self, options: LearnedCalibrationOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.clock = options, capture.clock
        self.guess = thresholds_of(capture, options.threshold)
        if options.thresholds == "fixed":
            self.thresholds = FixedThresholds(*self.guess)
        else:
            pixels = capture.camera.size if options.thresholds == "pixels" else None
            self.thresholds = LearnedThresholds(*self.guess, pixels=pixels)
        self.response: Response = FixedResponse(floor=FLOOR)
        if options.response == "residual":
            made = generator(seed, 0, "response")
            self.response = LogResidual(inputs="light", floor=FLOOR, generator=made)
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

    def both_thresholds(self) -> tuple[float, float]:
        """The thresholds to darker and to brighter, without what single pixels differ by."""
        if isinstance(self.thresholds, FixedThresholds):
            return self.guess
        negative, positive = (self.thresholds.log_guess + self.thresholds.log_factor).exp().tolist()
        return negative, positive

    def sensor_estimate(self) -> SensorEstimate:
        """What is believed of the event camera now, in steps too small to matter.

        In steps, so that images made from it need not be made anew at every step.
        """
        negative, positive = (
            math.exp(round(math.log(c) / THRESHOLD_STEP) * THRESHOLD_STEP)
            for c in self.both_thresholds()
        )
        late = round(self.offset_us / OFFSET_STEP_US) * OFFSET_STEP_US
        if isinstance(self.thresholds, FixedThresholds):
            negative, positive = self.guess
        return SensorEstimate(negative, positive, late)

    def on_time(self, time: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """When what events report really happened, both 0...1 of the capture."""
        if self.offset_steps is None:
            return time
        return time - self.offset_steps * (OFFSET_UNIT_US / self.clock.span_us)

    def prior(self) -> Float[Tensor, ""] | None:
        """What keeps the learned near its start; None if nothing needs it."""
        terms = []
        if isinstance(self.thresholds, LearnedThresholds) and self.thresholds.log_pixel is not None:
            terms.append(self.thresholds.prior())
        if self.log_gain is not None:
            terms.append(self.log_gain.mean().square() * GAIN_PRIOR)
        return torch.stack(terms).sum() if terms else None

    def groups(self, steps: int) -> list[Group]:
        """Parameters with their rates, over a schedule of so many steps."""
        options, own = self.options, self.thresholds
        offset = [] if self.offset_steps is None else [self.offset_steps]
        # What these two numbers learn is as good as the scene, which is best at the end.
        signs = [own.log_factor] if isinstance(own, LearnedThresholds) else []
        alone = {id(p) for p in (*offset, *signs)}
        others = [p for p in self.parameters() if id(p) not in alone]
        found = [
            ("unknowns", others, falling(options.rate, steps)),
            ("thresholds", signs, constant(options.rate)),
            ("offset", offset, falling(options.offset_rate_us / OFFSET_UNIT_US, steps)),
        ]
        return [Group(name, tuple(own), rate) for name, own, rate in found if own]


OFFSET_UNIT_US = 1000.0
"""The offset is learned in this unit, so that one rate suits it."""

OFFSET_STEP_US, THRESHOLD_STEP = 50, 0.01
"""Of a belief, in us and in natural log."""

FLOOR = 1e-4
"""Linear light added before the logarithm of what events see."""

GAIN_PRIOR = 1.0
"""Weight of the mean log gain, which the scene's own brightness could take up."""


def falling(rate: float, steps: int) -> Schedule:
    """A rate that falls to a twentieth over a schedule, so that what it moves comes to rest."""
    return exponential(rate, rate / 20, until=steps)


def with_learned_poses(capture: Capture, options: LearnedCalibrationOptions) -> Capture:
    """The capture with a correction of its trajectory to learn, if one is asked for."""
    if options.knots == 0:
        return capture
    tracks = 1 if capture.frames is None else int(capture.frames.track.max()) + 1
    path = LearnedKnots(capture.trajectory, knots=options.knots, tracks=tracks)
    return replace(capture, trajectory=path)


def with_learned_exposure_motion(capture: Capture, seed: int) -> Capture:
    """Photos of unknown motion as exposures whose motion is to be learned."""
    frames = capture.needed_frames
    middle = frames.exposure.middle_us
    gap = int(np.diff(np.sort(middle)).min()) if len(middle) > 1 else capture.clock.span_us
    half = max(int(gap * VIRTUAL_SHUTTER / 2), 1)
    exposure = replace(frames.exposure, open_us=middle - half, close_us=middle + half)
    opens, closes = (
        torch.from_numpy(capture.clock.unit(t)).float()
        for t in (exposure.open_us, exposure.close_us)
    )
    start = torch.zeros(len(frames), SHAKE_KNOTS, 6)
    made = generator(seed, 0, "shake")
    learned = torch.from_numpy(capture.split.train)
    start[learned] = FIRST_SHAKE * torch.randn(len(learned), SHAKE_KNOTS, 6, generator=made)
    by_track = torch.from_numpy(frames.track)
    path = LearnedExposureMotion(
        capture.trajectory,
        opens[by_track.argsort()],
        closes[by_track.argsort()],
        knots=SHAKE_KNOTS,
        start=start[by_track.argsort()],
    )
    return replace(capture, trajectory=path, frames=replace(frames, exposure=exposure))


def pose_groups(capture: Capture, rate: Schedule) -> list[Group]:
    """What of the trajectory is learned."""
    path = capture.trajectory
    learned = path.parameters() if isinstance(path, LearnedKnots | LearnedExposureMotion) else ()
    own = tuple(p for p in learned if p.requires_grad)
    return [Group("poses", own, rate)] if own else []
