"""Recipes on moving Gaussians: a moving scene from a rig of cameras, in minutes.

What moves are Gaussians that come, follow a curve and go; what stands still are others. Frames,
sharp or blurred, and events of any number of cameras say how: several cameras look at the same
moments.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

from sharpfield.core.capture import Capture
from sharpfield.core.paper import Paper
from sharpfield.recipes.settings.presets import Presets
from sharpfield.recipes.splats.dynamic_model import DynamicModel
from sharpfield.recipes.splats.dynamic_scene import DynamicOptions
from sharpfield.recipes.splats.learned_calibration import LearnedCalibrationOptions
from sharpfield.sampling.rig_views import RigSamplingOptions

R = TypeVar("R", bound="DynamicSplat")

LI = Paper(
    key="li2024spacetime",
    title="Spacetime Gaussian Feature Splatting for Real-Time Dynamic View Synthesis",
    bibtex="""@inproceedings{li2024spacetime,
  title     = {Spacetime {Gaussian} Feature Splatting for Real-Time Dynamic View Synthesis},
  author    = {Li, Zhan and Chen, Zhang and Li, Zhong and Xu, Yi},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2024}
}""",
    departures=(
        "Gaussians have one colour each: there are no features that a network turns into colours.",
        "They are opaque for most of their time and then fade fast, exp(-d^4/2) for exp(-d^2/2).",
        "What stands still are Gaussians of their own, before an even background.",
        "Moving ones start in the hull of each moment, not at points of structure from motion.",
        "The loss is the mean absolute difference alone, without structural similarity.",
    ),
)

OURS = Paper(
    key="sharpfield-ev-dynamic-splat",
    title="Moving Gaussians from frames and events of many cameras (sharpfield)",
    bibtex="""@software{sharpfield,
  title = {sharpfield: sharp radiance fields from blurry frames and events},
  note  = {Recipe ev-dynamic-splat. It builds on spacetime Gaussians (Li et al.,
           CVPR 2024), on the event double integral (Pan et al., CVPR 2019) and on EvDNeRF
           (Bhattacharya et al., WACV 2024)}
}""",
)


def draft(recipe: "DynamicSplat") -> "DynamicSplat":
    """Minutes on two CPU cores."""
    return recipe.lasting(8000)


def standard(recipe: "DynamicSplat") -> "DynamicSplat":
    """More Gaussians, and more cameras and instants in each step; an hour on a CPU."""
    return replace(
        recipe.lasting(20_000),
        gaussians=replace(recipe.gaussians, density=1.5, density_moving=4.5),
        looks=replace(recipe.looks, cameras=4, instants=5),
    )


@dataclass(frozen=True)
class DynamicSplat:
    """Moving Gaussians from frames alone. What events must beat."""

    paper: ClassVar[Paper] = LI
    presets: ClassVar[Presets] = Presets(sizes={"draft": draft, "standard": standard})

    steps: int = 10_000
    """Length of the schedule."""
    gaussians: DynamicOptions = field(default_factory=DynamicOptions)
    looks: RigSamplingOptions = field(
        default_factory=lambda: RigSamplingOptions(sharp=0.0, windows=0.0)
    )
    unknowns: LearnedCalibrationOptions = field(default_factory=LearnedCalibrationOptions)

    def lasting(self: R, steps: int) -> R:
        """The same recipe with its whole schedule stretched or shrunk; it is given in parts."""
        return replace(self, steps=steps)

    def build(self, capture: Capture, seed: int) -> DynamicModel:
        """On the frames alone, whatever else there is."""
        assert capture.needed_frames is not None
        return DynamicModel(self, capture.without(events=True), seed)


@dataclass(frozen=True)
class EvDynamicSplat(DynamicSplat):
    """Moving Gaussians from events, and from frames, sharp or blurred, if there are any."""

    paper: ClassVar[Paper] = OURS

    looks: RigSamplingOptions = field(default_factory=RigSamplingOptions)

    def build(self, capture: Capture, seed: int) -> DynamicModel:
        """On events and whatever frames there are."""
        assert capture.needed_events is not None
        return DynamicModel(self, capture, seed)
