"""The model of all splat recipes: Gaussians, the looks of each step, and the unknowns.

A step looks at whole images, or at a part of one, in one of two ways. *Early*, where events can
make sharp images, it looks at one instant, drawn from the whole capture, and compares one view
with the image that events carry there: cheap, and from everywhere. *Late* it looks at one
exposure: views at several instants of it whose mean is the blurred frame, and one instant beside
it, with the events counted between each two that follow each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import Batch, Depths, EventPairs, Instants, Pixels
from sharpfield.core.points import Growth
from sharpfield.core.protocols import PointSet
from sharpfield.core.rays import Radiance, Rays, Views
from sharpfield.core.schedule import Group
from sharpfield.core.tone import tone_of
from sharpfield.events.counts import on_frame_clock
from sharpfield.formation.mixing import mix, mix_of_few
from sharpfield.geometry.normalise import normalised
from sharpfield.geometry.rolling import Rolling
from sharpfield.losses.event_counts import event_terms
from sharpfield.losses.photometric import relative_depth_error
from sharpfield.metrics.quality import frame_weights
from sharpfield.recipes.splats.learned_calibration import (
    LearnedCalibration,
    LearnedCalibrationOptions,
    falling,
    pose_groups,
    with_learned_exposure_motion,
    with_learned_poses,
)
from sharpfield.recipes.splats.scene import GaussianOptions, SplatScene, cooldown
from sharpfield.recipes.splats.start import starting_gaussians
from sharpfield.sampling.views import SamplingOptions, ViewSampler

Terms = dict[str, Tensor]


@runtime_checkable
class SplatNumbers(Protocol):
    """The numbers of a splat recipe."""

    @property
    def steps(self) -> int:
        """Length of the schedule."""
        ...

    @property
    def gaussians(self) -> GaussianOptions:
        """What the scene is made of."""
        ...

    @property
    def looks(self) -> SamplingOptions:
        """What steps look at."""
        ...

    @property
    def unknowns(self) -> LearnedCalibrationOptions:
        """What else is learned."""
        ...


class SplatModel(nn.Module):
    """A splat recipe on one capture. Frames, events, or both: what is missing is left out.

    Args:
        recipe: With `gaussians`, `looks`, `unknowns` and `steps`.
        capture: As read.
        seed: Of the run.
    """

    def __init__(self, recipe: SplatNumbers, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.seed = recipe, seed
        self.options = recipe.looks
        self.capture, self.change = normalised(capture)
        if _motion_unknown(capture) and self.options.blur == "motion":
            self.capture = with_learned_exposure_motion(self.capture, seed)
        else:
            self.capture = with_learned_poses(self.capture, recipe.unknowns)
        self.path, self.shutter = self.capture.trajectory, Rolling.of(self.capture)
        aligned = align_events_to_rolling_shutter(self.capture)
        self.encoding = capture.frames.encoding if capture.frames else "gamma2.2"
        self.tone = tone_of(self.encoding)
        self.unknowns = LearnedCalibration(recipe.unknowns, self.capture, seed)
        weights = None
        if self.options.quality != "even" and aligned.frames is not None:
            weights = frame_weights(aligned, self.options.quality)[aligned.split.train]
        self.looks = ViewSampler(self.options, aligned, seed, weights)
        self.scene = SplatScene(
            recipe.gaussians,
            self.capture,
            starting_gaussians(
                recipe.gaussians,
                aligned,
                self.unknowns.guess,
                self.tone,
                seed,
                weights=self.looks.weights,
            ),
            self.tone,
            steps=recipe.steps,
            seed=seed,
        )
        early = self.options.early if self.looks.sharp is not None else 0.0
        self.late_from = int(early * recipe.steps)
        self.still_until = int(self.options.still * recipe.steps)
        settles = max(self.late_from, self.scene.last_growth)
        left = 1.0 if capture.frames is None else self.options.fading
        self.guidance = cooldown(settles, recipe.steps, left=left)

    @property
    def heaviest_step(self) -> int:
        """The first step that looks at several views."""
        several = max(self.late_from, self.still_until)
        return min(several, max(self.recipe.steps - 1, 0))

    def draw(self, step: int) -> Batch:
        """One instant in early steps; in late ones an exposure, or a stretch of events."""
        sensor_estimate = self.unknowns.sensor_estimate()
        if step < self.late_from:
            batch = self.looks.instant(step, sensor_estimate)
        elif self.capture.frames is None:
            batch = self.looks.stretch(step)
        elif self.unknowns.offset_steps is None or self.looks.motion is None:
            still = step < self.still_until
            batch = self.looks.exposure(
                step, events=not still, sensor_estimate=sensor_estimate, still=still
            )
        # Views of the frames' instants cannot tell when events really happened.
        elif step % 2:
            batch = self.looks.stretch(step)
        else:
            batch = self.looks.exposure(step, events=False, sensor_estimate=sensor_estimate)
        device = self.scene.gaussians.means.device
        return {name: seen.to(device) for name, seen in batch.items()}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Errors of sharp images, of the blurred one, and of the events between instants."""
        assert isinstance(look := batch["look"], Instants)
        frames, sharp, events = (batch.get(name) for name in ("frames", "sharp", "events"))
        only_events = events is not None and frames is None
        light = self._drawn(look, self.unknowns.on_time(look.time) if only_events else look.time)
        terms, guidance = self.scene.opacity_scale_penalty(step), self.guidance(step)
        if isinstance(frames, Pixels):
            blurred = self._exposed(self._mean(light, batch.get("rest")), frames.frame[:, 0, 0])
            terms["blur"] = (self.tone.encode(blurred) - frames.value).abs().mean()
        if isinstance(sharp, Pixels):
            weight = 1.0 if step < self.late_from else guidance * self.options.sharp
            stored = self.tone.encode(self._exposed(light.rgb, sharp.frame[:, 0, 0, 0]))
            terms["sharp"] = weight * (stored - sharp.value).abs().mean()
        if isinstance(depth := batch.get("depth"), Depths):
            drawn = light.depth.gather(-1, depth.instant[..., None])[..., 0]
            terms["depth"] = self.options.depth * relative_depth_error(drawn, depth.value)
        if isinstance(events, EventPairs):
            terms |= event_terms(
                light,
                events,
                response=self.unknowns.response,
                thresholds=self.unknowns.thresholds,
                learn_thresholds=self.unknowns.learns_thresholds,
                weight=guidance * self.options.windows,
            )
        if (prior := self.unknowns.prior()) is not None:
            terms["prior"] = prior
        return terms

    def _drawn(self, look: Instants, time: Float[Tensor, "m k"]) -> Radiance:
        """The views of some looks, as if they were taken at a time."""
        return self.scene.draw(
            Views(
                *(self.shutter.pose(time, look.track), time, look.weight, look.corner, look.size),
                rows=self.shutter.rows(time, look.track),
            )
        )

    def _mean(self, light: Radiance, rest: object) -> Float[Tensor, "m h w c"]:
        """The mean light over an exposure, with the gradient of the mean of a few of its views.

        A mean of few views is not that over the exposure: if it had to equal the blurred frame
        whatever the instants, a scene that is itself a little blurred would do best.
        """
        if not isinstance(rest, Instants):
            return mix(light)
        with torch.no_grad():
            others = self._drawn(rest, rest.time)
        return mix_of_few(light, others)

    def _exposed(self, light: Float[Tensor, "m *b c"], frame: Int64[Tensor, "m"]) -> Tensor:
        """Light as bright as each frame was exposed."""
        if self.unknowns.log_gain is None:
            return light
        return light * self.unknowns.log_gain[frame].exp().reshape(-1, *[1] * (light.ndim - 1))

    def draw_views(self, views: Views) -> Radiance:
        """Sharp linear light of whole views."""
        return self.scene.draw(views)

    def through(self, camera: Camera) -> "OtherLens":
        """The same scene, seen by another camera than the capture's."""
        return WithCamera(self.scene, camera)

    def render(self, rays: Rays) -> Radiance:
        """Not possible: Gaussians are drawn as whole views.

        Raises:
            OptionError: Always.
        """
        raise OptionError(
            "a scene of Gaussians draws whole views, not scattered rays",
            got=f"{rays.weight.numel()} rays",
            do="call draw_views",
        )

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """As the frames store it."""
        return self.tone.encode(light).clamp(0, 1)

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """What becomes of the Gaussians after a step."""
        return self.scene.grow(step)

    def groups(self) -> list[Group]:
        """Gaussians, unknowns and poses."""
        steps = max(self.recipe.steps, 1)
        return [
            *self.scene.groups(),
            *self.unknowns.groups(steps),
            *pose_groups(self.capture, falling(self.recipe.unknowns.poses_rate, steps)),
        ]


@dataclass(frozen=True)
class WithCamera:
    """A scene of Gaussians in front of a camera that did not record it."""

    scene: SplatScene
    camera: Camera

    def draw_views(self, views: Views) -> Radiance:
        """Sharp linear light of whole views."""
        return replace(self.scene.splatting, camera=self.camera)(self.scene.gaussians, views)


def align_events_to_rolling_shutter(capture: Capture) -> Capture:
    """The capture with the events that are learned from on the clock of its rolling shutter."""
    frames, events = capture.frames, capture.events
    if frames is None or events is None:
        return capture
    return replace(capture, events=on_frame_clock(events, frames.exposure.row_delay_us))


def _motion_unknown(capture: Capture) -> bool:
    return capture.known.motion == "unknown" and capture.frames is not None
