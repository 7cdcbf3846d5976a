"""The model of moving Gaussians: a scene, the looks of each step, and the unknowns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import Batch, EventPairs, Instants, Pixels
from sharpfield.core.points import Growth
from sharpfield.core.protocols import PointSet
from sharpfield.core.rays import Radiance, Rays, Views
from sharpfield.core.schedule import Group
from sharpfield.core.tone import luma, tone_of
from sharpfield.formation.mixing import mix, mix_of_few
from sharpfield.geometry.normalise import centred
from sharpfield.losses.event_counts import event_terms
from sharpfield.recipes.splats.dynamic_scene import DynamicOptions, DynamicScene
from sharpfield.recipes.splats.learned_calibration import (
    FLOOR,
    LearnedCalibration,
    LearnedCalibrationOptions,
    falling,
    pose_groups,
    with_learned_poses,
)
from sharpfield.recipes.splats.scene import cooldown
from sharpfield.sampling.rig_views import RigSamplingOptions, RigViewSampler
from sharpfield.storage.event_cache import event_index

Terms = dict[str, Tensor]


@runtime_checkable
class DynamicNumbers(Protocol):
    """The numbers of a recipe on moving Gaussians."""

    @property
    def steps(self) -> int:
        """Length of the schedule."""
        ...

    @property
    def gaussians(self) -> DynamicOptions:
        """What the scene is made of."""
        ...

    @property
    def looks(self) -> RigSamplingOptions:
        """What steps look at."""
        ...

    @property
    def unknowns(self) -> LearnedCalibrationOptions:
        """What else is learned."""
        ...


class DynamicModel(nn.Module):
    """Moving Gaussians on one capture. Frames, events, or both: what is missing is left out.

    Args:
        recipe: With `gaussians`, `looks`, `unknowns` and `steps`.
        capture: As read.
        seed: Of the run.
    """

    def __init__(self, recipe: DynamicNumbers, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.seed = recipe, seed
        moved, self.change = centred(capture)
        self.capture = with_learned_poses(moved, recipe.unknowns)
        self.path = self.capture.trajectory
        self.tone = tone_of(capture.frames.encoding if capture.frames else "gamma2.2")
        self.unknowns = LearnedCalibration(recipe.unknowns, self.capture, seed)
        offset = self.unknowns.offset_steps is not None
        self.looks = RigViewSampler(
            recipe.looks, self.capture, seed, steps=recipe.steps, offset=offset
        )
        # Without frames nothing says what stands still but what passes before it.
        alone = recipe.looks.still if capture.frames is not None else 0.0
        self.scene = DynamicScene(
            recipe.gaussians,
            self.capture,
            None if capture.events is None else event_index(capture.events),
            self.tone,
            steps=recipe.steps,
            still_until=int(alone * recipe.steps),
            seed=seed,
        )
        settles = max(self.looks.late_from, self.scene.last_growth)
        self.guidance = cooldown(settles, recipe.steps, left=recipe.looks.fading)
        floor = capture.known.log_floor
        self.floor = FLOOR if floor is None else floor

    @property
    def heaviest_step(self) -> int:
        """The first step that looks at several instants."""
        return min(self.looks.late_from, max(self.recipe.steps - 1, 0))

    def draw(self, step: int) -> Batch:
        """Several cameras at the same few instants."""
        batch = self.looks.draw(step, self.unknowns.sensor_estimate())
        device = self.scene.behind.device
        return {name: seen.to(device) for name, seen in batch.items()}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Errors of sharp images, of frames, and of the events between instants."""
        assert isinstance(look := batch["look"], Instants)
        frames, sharp, events = (batch.get(name) for name in ("frames", "sharp", "events"))
        only_events = events is not None and frames is None and sharp is None
        time = self.unknowns.on_time(look.time) if only_events else look.time
        light = self._drawn(look, time, step)
        terms = self.scene.terms(step)
        options, unknowns = self.recipe.looks, self.unknowns
        windows = options.alone if self.capture.frames is None else options.windows
        guidance = self.guidance(step) if isinstance(frames, Pixels) else 1.0
        if isinstance(frames, Pixels):
            blurred = mix(light)
            if isinstance(rest := batch.get("rest"), Instants):
                with torch.no_grad():
                    others = self._drawn(rest, rest.time, step)
                blurred = mix_of_few(light, others)
            stored = self.tone.encode(self._exposed(blurred, frames))
            terms["blur"] = (stored - frames.value).abs().mean()
        if isinstance(sharp, Pixels):
            weight = guidance * options.sharp if isinstance(frames, Pixels) else 1.0
            stored = self.tone.encode(light.rgb)
            terms["sharp"] = weight * (stored - sharp.value).abs().mean()
        if isinstance(events, EventPairs):
            terms |= event_terms(
                light,
                events,
                response=unknowns.response,
                thresholds=unknowns.thresholds,
                learn_thresholds=unknowns.learns_thresholds,
                weight=guidance * windows,
            )
        if (prior := unknowns.prior()) is not None:
            terms["prior"] = prior
        return terms

    def _drawn(self, look: Instants, time: Float[Tensor, "m k"], step: int) -> Radiance:
        """The views of some looks, as if they were taken at a time."""
        pose = self.path.pose(time, look.track)
        return self.scene.draw(Views(pose, time, look.weight, look.corner, look.size), step=step)

    def _exposed(self, light: Float[Tensor, "m h w c"], seen: Pixels) -> Tensor:
        if self.unknowns.log_gain is None:
            return light
        return light * self.unknowns.log_gain[seen.frame[:, :1, :1, None]].exp()

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

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """As the event camera sees it."""
        return (luma(light) + self.floor).log()

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
    """A moving scene in front of a camera that did not record it."""

    scene: DynamicScene
    camera: Camera

    def draw_views(self, views: Views) -> Radiance:
        """Sharp linear light of whole views."""
        return self.scene.draw(views, replace(self.scene.splatting, camera=self.camera))
