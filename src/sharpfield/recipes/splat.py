"""Recipes on Gaussians: sharp scenes, static or moving, in minutes.

Gaussians are rendered as whole views, and every measurement is made of views: a blurred frame is
the mean of several, events are the difference of the logarithms of two, and a deblurred frame is
one. The recipes differ in which measurements they use, in how they model the frames, and in whether
the scene moves.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Paper
from sharpfield.core.tone import tone_of
from sharpfield.events.threshold import FixedThresholds, thresholds_of
from sharpfield.initialisation.posed_images import sharp_light_images
from sharpfield.recipes.settings.presets import Presets, paper_of
from sharpfield.recipes.splats.learned_calibration import LearnedCalibrationOptions
from sharpfield.recipes.splats.model import SplatModel, align_events_to_rolling_shutter
from sharpfield.recipes.splats.scene import GaussianOptions, MotionOptions
from sharpfield.sampling.views import SamplingOptions

R = TypeVar("R", bound="Splat")

REFINED_KNOTS = 48
"""Knots of a refined trajectory."""

_MOVING = {
    "looks.still": "motion.static_warmup",
    "looks.alone": "sampling.event_only_weight",
    "gaussians.density_moving": "motion.density",
    "gaussians.span_ms": "motion.lifespan_ms",
    "gaussians.idle_moving": "motion.reg",
    "gaussians.fleeting": "motion.lifespan_penalty",
    "gaussians.spans_rate": "motion.lifespan_lr",
}

RENAMED = {
    "looks.instants": "sampling.grad_views",
    "looks.draws": "sampling.views",
    "looks.early": "sampling.edi_phase",
    "looks.still": "sampling.sharp_warmup",
    "looks.sharp": "sampling.latent_weight",
    "looks.windows": "sampling.event_weight",
    "looks.fading": "sampling.final_event_weight",
    "looks.shortest_us": "sampling.min_window_us",
    "looks.longest_us": "sampling.max_window_us",
    "looks.depth": "sampling.depth_weight",
    "looks.quality": "sampling.frame_quality",
    "looks.part": "sampling.crop",
    "looks": "sampling",
    "unknowns.rate": "calibration.lr",
    "unknowns.poses_rate": "calibration.poses_lr",
    "unknowns.offset_rate_us": "calibration.offset_lr_us",
    "unknowns": "calibration",
    "gaussians.budget": "gaussians.cap_max",
    "gaussians.degree": "gaussians.sh_degree",
    "gaussians.size": "gaussians.scale",
    "gaussians.idle": "gaussians.reg",
    "gaussians.rates": "gaussians.lr",
}
"""Former names of options, for hints; single options come before their group: the first counts."""

RENAMED_MOVING = _MOVING | {old: new for old, new in RENAMED.items() if old not in _MOVING}
"""The same of recipes for moving scenes."""


def refine(recipe: R) -> R:
    """Thresholds, poses and the clocks' offset are learned, too."""
    calibration = replace(recipe.calibration, thresholds="signs", knots=REFINED_KNOTS, offset=True)
    sampling = replace(recipe.sampling, sharp_warmup=0.0)
    if sampling.latent_weight > 0:
        # Latent frames are made with the thresholds as known by now, and would confirm them.
        sampling = replace(
            sampling, edi_phase=0.3, latent_weight=0.01, event_weight=0.01, max_window_us=200_000
        )
    return replace(recipe, sampling=sampling, calibration=calibration)


def draft(recipe: R) -> R:
    """Minutes on two CPU cores."""
    return recipe.lasting(6000)


def standard(recipe: R) -> R:
    """Minutes on a GPU: more Gaussians, of SH degree 3, and more views of each exposure."""
    sampling = recipe.sampling
    return replace(
        recipe.lasting(15_000),
        gaussians=replace(recipe.gaussians, sh_degree=3, density=1.5),
        sampling=replace(
            sampling, grad_views=max(sampling.grad_views, 5), views=max(sampling.views, 15)
        ),
    )


@dataclass(frozen=True)
class Splat:
    """Gaussians from frames taken as sharp. The baseline of the fast recipes."""

    paper: ClassVar[Paper] = paper_of("splat")
    presets: ClassVar[Presets] = Presets({"refine": refine}, {"draft": draft, "standard": standard})
    renamed: ClassVar[dict[str, str]] = RENAMED

    steps: int = 15_000
    """Length of the schedule."""
    gaussians: GaussianOptions = field(default_factory=GaussianOptions)
    sampling: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(blur="none", latent_weight=0.0, event_weight=0.0)
    )
    calibration: LearnedCalibrationOptions = field(default_factory=LearnedCalibrationOptions)

    def lasting(self: R, steps: int) -> R:
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(self, steps=steps)

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """The recipe on one capture."""
        return self._model(capture, seed)

    def _model(
        self, capture: Capture, seed: int, motion: MotionOptions | None = None
    ) -> SplatModel:
        return SplatModel(
            capture,
            seed,
            steps=self.steps,
            gaussians=self.gaussians,
            sampling=self.sampling,
            calibration=self.calibration,
            motion=motion,
        )


@dataclass(frozen=True)
class EdiSplat(Splat):
    """Gaussians from frames deblurred with events first. The baseline everyone must beat."""

    paper: ClassVar[Paper] = paper_of("edi-splat")

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """On the deblurred frames."""
        return self._model(deblurred(capture, self.calibration), seed)


@dataclass(frozen=True)
class BlurSplat(Splat):
    """Gaussians and the motion of the camera inside each exposure, from blurry frames alone."""

    paper: ClassVar[Paper] = paper_of("blur-splat")

    sampling: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(
            grad_views=5, views=15, latent_weight=0.0, event_weight=0.0
        )
    )
    calibration: LearnedCalibrationOptions = field(
        default_factory=lambda: LearnedCalibrationOptions(knots=16)
    )


@dataclass(frozen=True)
class EventSplat(Splat):
    """Gaussians from events alone; brightness is known up to a gain and an offset."""

    paper: ClassVar[Paper] = paper_of("event-splat")

    sampling: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(latent_weight=0.0, event_weight=0.04)
    )

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """On the events alone, whatever else there is."""
        assert capture.needed_events is not None
        return self._model(capture.without(frames=True), seed)


@dataclass(frozen=True)
class EvSplat(Splat):
    """Gaussians from blurry frames and events: first latent frames, then both as measured."""

    paper: ClassVar[Paper] = paper_of("ev-splat")

    sampling: SamplingOptions = field(default_factory=SamplingOptions)


@dataclass(frozen=True)
class RoomSplat(Splat):
    """Gaussians from a walk through a room with a blurry camera, with measured depth.

    The scene starts on what a depth camera measured, or on a point cloud; sharp frames are sampled
    more often than blurred ones; blur is the mean of views along the motion of the camera inside
    each exposure, known or learned. Where there are events, they tell which frames are blurred, and
    give latent frames.
    """

    paper: ClassVar[Paper] = paper_of("room-splat")

    gaussians: GaussianOptions = field(default_factory=lambda: GaussianOptions(density=1.5))
    sampling: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(
            sharp_warmup=0.5, frame_quality="auto", depth_weight=0.1
        )
    )


def moving_draft(recipe: R) -> R:
    """Minutes on two CPU cores."""
    return recipe.lasting(8000)


def moving_standard(recipe: "DynamicSplat") -> "DynamicSplat":
    """More Gaussians, and more cameras and instants in each step; an hour on a CPU."""
    return replace(
        recipe.lasting(20_000),
        gaussians=replace(recipe.gaussians, density=1.5),
        motion=replace(recipe.motion, density=4.5),
        sampling=replace(recipe.sampling, cameras=4, grad_views=5, views=15),
    )


@dataclass(frozen=True)
class DynamicSplat(Splat):
    """Static and moving Gaussians from frames alone. The baseline of moving scenes."""

    paper: ClassVar[Paper] = paper_of("dynamic-splat")
    presets: ClassVar[Presets] = Presets(
        {"refine": refine}, {"draft": moving_draft, "standard": moving_standard}
    )
    renamed: ClassVar[dict[str, str]] = RENAMED_MOVING

    steps: int = 10_000
    """Length of the schedule."""
    gaussians: GaussianOptions = field(
        default_factory=lambda: GaussianOptions(
            density=0.75, min_count=400, sh_degree=0, background=None
        )
    )
    motion: MotionOptions = field(default_factory=MotionOptions)
    sampling: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(cameras=2, latent_weight=0.0, event_weight=0.0)
    )

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """On the frames alone, whatever else there is."""
        assert capture.needed_frames is not None
        return self._model(capture.without(events=True), seed, self.motion)


@dataclass(frozen=True)
class EvDynamicSplat(DynamicSplat):
    """Static and moving Gaussians from events, and frames, sharp or blurred, if there are any."""

    paper: ClassVar[Paper] = paper_of("ev-dynamic-splat")

    sampling: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(
            cameras=2, edi_phase=0.7, latent_pairs=True, event_only_weight=0.1
        )
    )

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """On events and whatever frames there are."""
        assert capture.needed_events is not None
        return self._model(capture, seed, self.motion)


def deblurred(capture: Capture, calibration: LearnedCalibrationOptions) -> Capture:
    """The capture with its blurry training frames replaced by latent frames from events.

    Raises:
        CaptureError: It has no events, or no frames.
    """
    frames = capture.needed_frames
    assert capture.needed_events is not None
    thresholds = FixedThresholds(*thresholds_of(capture, calibration.threshold))
    images, train = np.array(frames.images), capture.split.train
    tone = tone_of(frames.encoding)
    aligned = align_events_to_rolling_shutter(capture)
    for i, light in zip(train, sharp_light_images(aligned, thresholds, train), strict=True):
        images[i] = np.rint(tone.encode(light).numpy() * frames.white)
    middle = frames.exposure.middle_us
    exposure = replace(frames.exposure, open_us=middle, close_us=middle)
    return replace(capture, frames=replace(frames, images=images, exposure=exposure))
