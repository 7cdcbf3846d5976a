"""The model of all recipes on Gaussians, static or moving: sample views, render, compare.

A step renders whole views, or crops of them, in one of two ways. In the *EDI phase*, where events
give latent frames, it compares one view of each camera with the latent frame at that instant. After
it, it renders one exposure: views at several instants whose mean is the blurred frame, and one
instant beside it, with the events counted from each to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.captures.splits import Block
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import Batch, Depths, EventPairs, Instants, Pixels, Terms
from sharpfield.core.protocols import Growth, PointSet
from sharpfield.core.rays import Radiance, Rays, Views
from sharpfield.core.schedule import Group
from sharpfield.core.seed import generator
from sharpfield.core.tone import tone_of
from sharpfield.events.counts import subtract_row_delay
from sharpfield.fields.gaussians.dynamic import MovingGaussians
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.formation.exposure import EventWindow, ExposureOfViews
from sharpfield.geometry.normalise import normalised, recentred
from sharpfield.geometry.rolling import Rolling
from sharpfield.initialisation.static_scene import backdrop_points, static_points
from sharpfield.initialisation.visual_hull import moving_gaussians
from sharpfield.losses.events import count_error, threshold_error
from sharpfield.losses.photometric import l1, relative_depth_error
from sharpfield.metrics.quality import frame_weights
from sharpfield.recipes.splats.learned_calibration import (
    LearnedCalibration,
    LearnedCalibrationOptions,
    falling,
    pose_groups,
    with_learned_exposure_motion,
    with_learned_poses,
)
from sharpfield.recipes.splats.scene import GaussianOptions, MotionOptions, SplatScene, cooldown
from sharpfield.sampling.views import SamplingOptions, ViewSampler
from sharpfield.storage.event_cache import event_index


class SplatModel(nn.Module):
    """Gaussians on one capture. Frames, events, or both: what is missing is left out.

    Args:
        capture: As read.
        seed: Of the run.
        steps: Length of the schedule.
        gaussians: The static Gaussians, and how Gaussians grow.
        sampling: Which views a step renders, and the weights of losses.
        calibration: Which parts of the calibration are learned.
        motion: The moving Gaussians; None for a static scene.
    """

    def __init__(
        self,
        capture: Capture,
        seed: int,
        *,
        steps: int,
        gaussians: GaussianOptions,
        sampling: SamplingOptions,
        calibration: LearnedCalibrationOptions,
        motion: MotionOptions | None = None,
    ) -> None:
        super().__init__()
        self.steps, self.seed, self.sampling = steps, seed, sampling
        # A hull of what moves needs a box around the scene; a static one keeps its near depth.
        self.capture, self.change = normalised(capture) if motion is None else recentred(capture)
        unknown = capture.known.motion == "unknown" and capture.frames is not None
        if unknown and sampling.blur == "motion":
            self.capture = with_learned_exposure_motion(self.capture, seed)
        else:
            self.capture = with_learned_poses(self.capture, calibration)
        self.path, self.shutter = self.capture.trajectory, Rolling.of(self.capture)
        aligned = align_events_to_rolling_shutter(self.capture)
        self.encoding = capture.frames.encoding if capture.frames else "gamma2.2"
        self.tone = tone_of(self.encoding)
        self.calibration = LearnedCalibration(calibration, self.capture, seed)
        weights = None
        if sampling.frame_quality != "even" and aligned.frames is not None:
            weights = frame_weights(aligned, sampling.frame_quality)[aligned.split.train]
        self.sampler = ViewSampler(
            sampling,
            aligned,
            seed,
            steps=steps,
            weights=weights,
            separate_events=self.calibration.offset_steps is not None,
        )
        self.scene = SplatScene(
            gaussians,
            self.capture,
            self._static_start(gaussians, aligned, moves=motion is not None),
            None if motion is None else (self._moving_start(gaussians, motion, aligned), motion),
            self.tone,
            steps=steps,
            seed=seed,
        )
        settled = max(self.sampler.edi_until, self.scene.last_growth)
        sharp = capture.frames is None or self.sampler.pairs
        left = 1.0 if sharp else sampling.final_event_weight
        self.event_decay = cooldown(settled, steps, left=left)
        self.events_weight = sampling.events_weight(capture)
        self.poses_lr = falling(calibration.poses_lr, max(steps, 1))

    def _static_start(
        self, options: GaussianOptions, capture: Capture, *, moves: bool
    ) -> Gaussians:
        made = generator(self.seed, 0, "start")
        count = max(int(options.start * options.count(capture)), 1)
        if moves:
            start = backdrop_points(capture, count, made, size=options.scale)
        else:
            start = static_points(
                capture,
                self.tone,
                self.calibration.first_thresholds,
                count,
                made,
                weights=self.sampler.weights,
                size=options.scale,
            )
        return Gaussians.start(
            torch.from_numpy(start.points),
            self.tone.encode(torch.from_numpy(start.colours)),
            torch.from_numpy(start.sizes),
            sh_degree=options.sh_degree,
            opacity=options.opacity,
        )

    def _moving_start(
        self, options: GaussianOptions, motion: MotionOptions, capture: Capture
    ) -> MovingGaussians:
        count = max(int(options.start * motion.count(options, capture)), 1)
        events = capture.events
        return moving_gaussians(
            capture,
            None if events is None or events.rectified else event_index(events),
            self.tone,
            count,
            self.seed,
            lifespan=motion.lifespan(capture),
            opacity=options.opacity,
        )

    @property
    def heaviest_step(self) -> int:
        """The first step that renders several views."""
        several = max(self.sampler.edi_until, self.sampler.sharp_until)
        return min(several, max(self.steps - 1, 0))

    @property
    def exposure(self) -> ExposureOfViews:
        """What frames are of views."""
        return ExposureOfViews(self.shutter, self.tone.encode, self.calibration.log_gain)

    @property
    def window(self) -> EventWindow:
        """What counted events are of views."""
        return EventWindow(self.shutter, self.calibration.response)

    def draw(self, step: int) -> Batch:
        """What a step renders, and what was measured of it, see `ViewSampler.draw`."""
        batch = self.sampler.draw(step, self.calibration.sensor_estimate())
        device = self.scene.static.means.device
        return {name: seen.to(device) for name, seen in batch.items()}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Errors of latent frames, of the blurred frame, and of the events between instants."""
        assert isinstance(seen := batch["views"], Instants)
        views, exposure = self._views(seen, batch), self.exposure
        light = self.scene.draw(views, step=step)  # [m, h, w, k]
        terms, decay = self.scene.penalties(step), self.event_decay(step)
        if isinstance(frames := batch.get("frames"), Pixels):
            blurred = exposure.observe(light, frames, self._no_grad(batch, step))
            terms["blur"] = l1(blurred, frames.value)
        if isinstance(latent := batch.get("latent_frames"), Pixels):
            weight = decay * self.sampling.latent_weight if "frames" in batch else 1.0
            terms["latent"] = weight * l1(exposure.observe_each(light, latent), latent.value)
        if isinstance(depth := batch.get("depth"), Depths):
            rendered = light.depth.gather(-1, depth.instant[..., None])[..., 0]  # [m, h, w]
            terms["depth"] = self.sampling.depth_weight * relative_depth_error(
                rendered, depth.value
            )
        if isinstance(events := batch.get("events"), EventPairs):
            change, thresholds = self.window.observe(light, events), self.calibration.thresholds
            weight = decay * self.events_weight
            terms["events"] = weight * count_error(change, events, thresholds)
            if self.calibration.learns_thresholds:
                terms["thresholds"] = weight * threshold_error(change, events, thresholds)
        if (prior := self.calibration.prior()) is not None:
            terms["prior"] = prior
        return terms

    def _views(self, seen: Instants, batch: Batch) -> Views:
        """By the clock of the frames, or by that of the events where there are only these."""
        if batch.keys() == {"views", "events"}:
            return self.window.expose(seen, self.calibration.corrected_time(seen.time))
        return self.exposure.expose(seen)

    def _no_grad(self, batch: Batch, step: int) -> Radiance | None:
        """The light of the views of an exposure that the scene does not learn through."""
        if not isinstance(seen := batch.get("no_grad_views"), Instants):
            return None
        with torch.no_grad():
            return self.scene.draw(self.exposure.expose(seen), step=step)

    def draw_views(self, views: Views) -> Radiance:
        """Sharp linear light of whole views."""
        return self.scene.draw(views)

    def through(self, camera: Camera) -> "WithCamera":
        """The same scene, seen by another camera than the capture's."""
        return WithCamera(self.scene, camera)

    def render(self, rays: Rays) -> Radiance:
        """Not possible: Gaussians are rendered as whole views.

        Raises:
            OptionError: Always.
        """
        raise OptionError(
            "a scene of Gaussians renders whole views, not scattered rays",
            got=f"{rays.weight.numel()} rays",
            do="call draw_views",
        )

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """As the frames store it."""
        return self.tone.encode(light).clamp(0, 1)

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """As the event camera sees it: natural log of the luma, through the learned response."""
        return self.calibration.log_light(light)

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """What becomes of the Gaussians after a step."""
        return self.scene.grow(step)

    def groups(self) -> list[Group]:
        """Gaussians, calibration and poses."""
        return [
            *self.scene.groups(),
            *self.calibration.groups(max(self.steps, 1)),
            *pose_groups(self.capture, self.poses_lr),
        ]


@dataclass(frozen=True)
class WithCamera:
    """A scene of Gaussians in front of a camera that did not record it."""

    scene: SplatScene
    camera: Camera

    def draw_views(self, views: Views) -> Radiance:
        """Sharp linear light of whole views."""
        return self.scene.draw(views, self.camera)


def align_events_to_rolling_shutter(capture: Capture) -> Capture:
    """The capture with its training events on the clock of the first row of its rolling shutter."""
    frames, events = capture.frames, capture.events
    if frames is None or events is None:
        return capture
    return replace(capture, events=subtract_row_delay(events, frames.exposure.row_delay_us))


def merge_blocks(models: Sequence[object], blocks: Sequence[Block]) -> SplatModel:
    """The first model with the Gaussians of all, static and moving.

    Its learned calibration (thresholds, gains, poses) is that of the first model.

    Args:
        models: Trained on one block each, in the order of `blocks`.
        blocks: Of one capture.

    Raises:
        OptionError: A model is not made of Gaussians, or their world frames differ.
    """
    splats = [model for model in models if isinstance(model, SplatModel)]
    if len(splats) != len(models):
        raise OptionError(
            "only scenes of Gaussians can be merged",
            got=", ".join(sorted({type(model).__module__ for model in models})),
            do="train a splat recipe, such as room-splat",
        )
    first = splats[0]
    for other in splats[1:]:
        if abs(other.change.scale / first.change.scale - 1) > 1e-9:
            raise OptionError("the world frames of blocks differ", do="train them on one capture")
    for kind in ("static", "moving"):
        parts = [
            _inside_block(model, getattr(model.scene, kind), block)
            for model, block in zip(splats, blocks, strict=True)
            if getattr(model.scene, kind) is not None
        ]
        if parts:
            merged = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
            getattr(first.scene, kind).replace(merged)
    return first


def _inside_block(model: SplatModel, gaussians: Gaussians, block: Block) -> dict[str, Tensor]:
    """The parameters of the Gaussians whose means lie in a block."""
    means = model.change.inverse().points(gaussians.means.detach().cpu().double().numpy())
    inside = torch.from_numpy(block.contains(means)).to(gaussians.means.device)
    return {name: tensor.detach()[inside] for name, tensor in gaussians.points().items()}
