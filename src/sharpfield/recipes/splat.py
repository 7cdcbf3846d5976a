"""Recipes on Gaussians: sharp scenes in minutes.

Gaussians are drawn as whole views, and every measurement is made of views: a blurred frame is the
mean of several, events are the difference of the logarithms of two, and a deblurred frame is one.
The recipes differ in what they believe of the frames and of the camera.

Rooms on Gaussians: sharp large scenes from a walk with a blurry camera, in minutes.

The ideas of P. Dai et al., *Hybrid Neural Rendering for Large-Scale Scenes with Motion Blur*,
CVPR 2023, on another engine: the scene starts on what a depth camera measured, or on a point
cloud; frames that are sharp teach more than blurred ones; and blur is simulated while training.
Here it is the mean of views along the motion of the camera inside each exposure, known or learned.
Where the capture has events, these say which frames are blurred, and make them sharp.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.paper import Paper
from sharpfield.core.tone import tone_of
from sharpfield.events.threshold import FixedThresholds, thresholds_of
from sharpfield.initialisation.posed_images import sharp_light_images
from sharpfield.recipes.hybrid import PAPER
from sharpfield.recipes.settings.presets import Presets
from sharpfield.recipes.splats.learned_calibration import LearnedCalibrationOptions
from sharpfield.recipes.splats.model import SplatModel, align_events_to_rolling_shutter
from sharpfield.recipes.splats.scene import GaussianOptions
from sharpfield.sampling.views import SamplingOptions

R = TypeVar("R", bound="Splat")

KERBL = Paper(
    key="kerbl2023gaussians",
    title="3D Gaussian Splatting for Real-Time Radiance Field Rendering",
    bibtex="""@article{kerbl2023gaussians,
  title   = {{3D} Gaussian Splatting for Real-Time Radiance Field Rendering},
  author  = {Kerbl, Bernhard and Kopanas, Georgios and Leimk{\\"u}hler, Thomas and
             Drettakis, George},
  journal = {ACM Transactions on Graphics},
  volume  = {42},
  number  = {4},
  year    = {2023}
}""",
    departures=(
        "Gaussians hold stored colours, but light is blended: a view is encoded as frames are"
        " only after blending, because blur adds up light.",
        "The loss is the mean absolute difference alone, without structural similarity.",
        "Dead Gaussians move to live ones (Markov chain Monte Carlo, NeurIPS 2024) unless"
        " gaussians.growth is `classic`.",
        "Splats thinner than a pixel are drawn fainter (Mip-Splatting, CVPR 2024).",
    ),
)

PAN = Paper(
    key="pan2019edi",
    title="Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera",
    bibtex="""@inproceedings{pan2019edi,
  title     = {Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera},
  author    = {Pan, Liyuan and Scheerlinck, Cedric and Yu, Xin and Hartley, Richard and
               Liu, Miaomiao and Dai, Yuchao},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2019}
}""",
    departures=KERBL.departures,
)

ZHAO = Paper(
    key="zhao2024badgaussians",
    title="BAD-Gaussians: Bundle Adjusted Deblur Gaussian Splatting",
    bibtex="""@inproceedings{zhao2024badgaussians,
  title     = {{BAD-Gaussians}: Bundle Adjusted Deblur Gaussian Splatting},
  author    = {Zhao, Lingzhe and Wang, Peng and Liu, Peidong},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year      = {2024}
}""",
    departures=(
        *KERBL.departures,
        "Where the capture knows the motion of the camera it is believed, up to a smooth learned"
        " correction; only photos of unknown motion get a motion of their own.",
        "That motion is a cubic B-spline of twists, not a line.",
    ),
)

XIONG = Paper(
    key="xiong2024event3dgs",
    title="Event3DGS: Event-Based 3D Gaussian Splatting for High-Speed Robot Egomotion",
    bibtex="""@inproceedings{xiong2024event3dgs,
  title     = {{Event3DGS}: Event-Based {3D} Gaussian Splatting for High-Speed Robot Egomotion},
  author    = {Xiong, Tianyi and Wu, Jiayi and He, Botao and Fermuller, Cornelia and
               Aloimonos, Yiannis and Huang, Heng and Metzler, Christopher},
  booktitle = {Conference on Robot Learning (CoRL)},
  year      = {2024}
}""",
    departures=(
        *KERBL.departures,
        "Windows of random length are counted exactly; silent pixels may change by a threshold.",
    ),
)

OURS = Paper(
    key="sharpfield-ev-splat",
    title="Gaussians from blurry frames and events (sharpfield)",
    bibtex="""@software{sharpfield,
  title = {sharpfield: sharp radiance fields from blurry frames and events},
  note  = {Recipe ev-splat. It builds on the event double integral (Pan et al., CVPR 2019), on
           3D Gaussian splatting (Kerbl et al., SIGGRAPH 2023) and its Markov chain Monte Carlo
           view (Kheradmand et al., NeurIPS 2024)}
}""",
)


REFINED_KNOTS = 48
"""Knots of a refined trajectory."""


def refine(recipe: "Splat") -> "Splat":
    """Thresholds, poses and the clocks' offset are learned, too."""
    unknowns = replace(recipe.unknowns, thresholds="signs", knots=REFINED_KNOTS, offset=True)
    looks = recipe.looks
    if looks.sharp > 0:
        # Sharp images are made with the thresholds that are believed, and would confirm them.
        looks = replace(looks, early=0.3, sharp=0.01, windows=0.01, longest_us=200_000)
    return replace(recipe, looks=looks, unknowns=unknowns)


def draft(recipe: "Splat") -> "Splat":
    """Minutes on two CPU cores."""
    return recipe.lasting(6000)


def standard(recipe: "Splat") -> "Splat":
    """Minutes on a GPU: more Gaussians, of SH degree 3, and more views of each exposure."""
    return replace(
        recipe.lasting(15_000),
        gaussians=replace(recipe.gaussians, degree=3, density=1.5),
        looks=replace(recipe.looks, instants=max(recipe.looks.instants, 5)),
    )


@dataclass(frozen=True)
class Splat:
    """Gaussians from frames taken as they are. The baseline of the fast recipes."""

    paper: ClassVar[Paper] = KERBL
    presets: ClassVar[Presets] = Presets({"refine": refine}, {"draft": draft, "standard": standard})

    steps: int = 15_000
    """Length of the schedule."""
    gaussians: GaussianOptions = field(default_factory=GaussianOptions)
    looks: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(blur="none", sharp=0.0, windows=0.0)
    )
    unknowns: LearnedCalibrationOptions = field(default_factory=LearnedCalibrationOptions)

    def lasting(self: R, steps: int) -> R:
        """The same recipe with its whole schedule stretched or shrunk; it is given in parts."""
        return replace(self, steps=steps)

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """The recipe on one capture."""
        return SplatModel(self, capture, seed)


@dataclass(frozen=True)
class EdiSplat(Splat):
    """Gaussians from frames deblurred with events first. The baseline everyone must beat."""

    paper: ClassVar[Paper] = PAN

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """On the deblurred frames."""
        return SplatModel(self, deblurred(capture, self.unknowns), seed)


@dataclass(frozen=True)
class BlurSplat(Splat):
    """Gaussians and the motion of the camera inside each exposure, from blurry frames alone."""

    paper: ClassVar[Paper] = ZHAO

    looks: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(instants=5, sharp=0.0, windows=0.0)
    )
    unknowns: LearnedCalibrationOptions = field(
        default_factory=lambda: LearnedCalibrationOptions(knots=16)
    )


@dataclass(frozen=True)
class EventSplat(Splat):
    """Gaussians from events alone; brightness is known up to a gain and an offset."""

    paper: ClassVar[Paper] = XIONG

    looks: SamplingOptions = field(default_factory=lambda: SamplingOptions(sharp=0.0, windows=0.04))

    def build(self, capture: Capture, seed: int) -> SplatModel:
        """On the events alone, whatever else there is."""
        assert capture.needed_events is not None
        return SplatModel(self, capture.without(frames=True), seed)


@dataclass(frozen=True)
class EvSplat(Splat):
    """Gaussians from blurry frames and events together: first sharp images, then both as is."""

    paper: ClassVar[Paper] = OURS

    looks: SamplingOptions = field(default_factory=SamplingOptions)


def deblurred(capture: Capture, unknowns: LearnedCalibrationOptions) -> Capture:
    """The capture with its blurry training frames replaced by sharp ones from events.

    Raises:
        CaptureError: It has no events, or no frames.
    """
    frames = capture.needed_frames
    assert capture.needed_events is not None
    thresholds = FixedThresholds(*thresholds_of(capture, unknowns.threshold))
    images, train = np.array(frames.images), capture.split.train
    tone = tone_of(frames.encoding)
    for i, light in zip(
        train,
        sharp_light_images(align_events_to_rolling_shutter(capture), thresholds, train),
        strict=True,
    ):
        images[i] = np.rint(tone.encode(light).numpy() * frames.white)
    middle = frames.exposure.middle_us
    exposure = replace(frames.exposure, open_us=middle, close_us=middle)
    sharp = replace(frames, images=images, exposure=exposure)
    return replace(capture, frames=sharp)


DAI = replace(
    PAPER,
    departures=(
        "Gaussians instead of neural points and image features.",
        "Blur is the mean of views along the camera's motion, instead of a kernel for each patch.",
        "Frames are drawn as often as their quality says, instead of weighing their loss.",
        "What the depth camera measured is a loss, too.",
    ),
)


@dataclass(frozen=True)
class RoomSplat(Splat):
    """Gaussians from a walk through a room: depth, quality weights, and blur along the motion."""

    paper: ClassVar[Paper] = DAI

    gaussians: GaussianOptions = field(default_factory=lambda: GaussianOptions(density=1.5))
    looks: SamplingOptions = field(
        default_factory=lambda: SamplingOptions(still=0.5, quality="auto", depth=0.1)
    )
