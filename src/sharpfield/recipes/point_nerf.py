"""Point-NeRF: a sharp scene from neural points, blur and all. The baseline of `hybrid`.

Q. Xu et al., *Point-NeRF: Point-based Neural Radiance Fields*, CVPR 2022. Points from depth carry
learned descriptors; the few around a place on a ray tell its density and colour.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

from sharpfield.core.capture import Capture
from sharpfield.core.paper import Paper
from sharpfield.fields.points.networks import PointSizes
from sharpfield.initialisation.point_cloud import CloudOptions
from sharpfield.recipes.points.growth import GrowthOptions
from sharpfield.recipes.points.model import DrawOptions, PointModel
from sharpfield.recipes.points.scene import MarchOptions, PointScene
from sharpfield.recipes.settings.presets import Presets

R = TypeVar("R", bound="PointNeRF")

PAPER = Paper(
    key="xu2022pointnerf",
    title="Point-NeRF: Point-based Neural Radiance Fields",
    bibtex="""@inproceedings{xu2022pointnerf,
  title     = {{Point-NeRF}: Point-based Neural Radiance Fields},
  author    = {Xu, Qiangeng and Xu, Zexiang and Philip, Julien and Bi, Sai and Shu, Zhixin and
               Sunkavalli, Kalyan and Neumann, Ulrich},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2022}
}""",
    departures=(
        "Neighbours are the nearest in the window of cells; the released code stops at the first"
        " layer of cells that holds enough, and drops points by chance where a cell is full.",
        "Descriptors start by chance; the released code starts them, and the networks, from"
        " weights trained on another data set for a day.",
        "The regulariser of confidence leaves out empty slots, which the released code fills with"
        " the first point.",
        "Rows of points that a step does not touch are left alone; the released code moves all by"
        " the momentum of Adam.",
        "Steps are uneven by the seed and step, so a run can be repeated.",
    ),
)


P = TypeVar("P", bound="PointNeRF")


def draft(recipe: P) -> P:
    """Minutes on two CPU cores: small networks on averaged neighbours, and first colours."""
    recipe = quick(recipe, points=50_000, width=64, feature=64, pixels=1024, asked=12)
    return replace(recipe.lasting(2000), rate=2e-3, points_rate=5e-3, decay=0.05)


def standard(recipe: P) -> P:
    """Minutes on a GPU, hours on a CPU."""
    recipe = quick(recipe, points=1_000_000, width=128, feature=128, pixels=3136, asked=16)
    return replace(recipe.lasting(20_000), rate=1e-3, points_rate=4e-3, decay=0.05)


def published(recipe: P) -> P:
    """The published networks, points and length."""
    return recipe


def quick(recipe: P, *, points: int, width: int, feature: int, pixels: int, asked: int) -> P:
    """What needs no weights of another data set to learn fast."""
    whole = recipe.drawn.side**2
    drawn = DrawOptions(
        patches=max(pixels // whole, 1),
        side=recipe.drawn.side,
        apart=(1, 3),
        frames=8,
        border=0,
    )
    return replace(
        recipe,
        start_colours=True,
        drawn=drawn,
        cloud=CloudOptions(
            budget=points, colours="fused", nearest=0.0, farthest=float("inf"), frames="train"
        ),
        sizes=PointSizes(
            channels=16,
            width=width,
            feature=feature,
            octaves=(0, 3, 2),
            axes="world",
            average="early",
            unit=0.0,
        ),
        march=MarchOptions(voxel=0.0, steps=0, asked=asked, thickness=1.0, background=0.5),
        growth=GrowthOptions(every=0.1, until=0.5, most=2 * points),
    )


@dataclass(frozen=True)
class PointNeRF:
    """Neural points from depth to a scene, blur and all."""

    paper: ClassVar[Paper] = PAPER
    presets: ClassVar[Presets] = Presets(
        sizes={"draft": draft, "standard": standard, "paper": published}
    )

    steps: int = 200_000
    """Length of the schedule."""
    rate: float = 5e-4
    """First learning rate of networks."""
    points_rate: float = 2e-3
    """First learning rate of points."""
    decay: float = 0.63
    """What is left of the rates at the end."""
    decisive: float = 1e-4
    """Weight of the term that makes confidences 0 or 1."""
    start_colours: bool = False
    """The network adds to colours that points and images have, instead of making its own."""
    drawn: DrawOptions = field(default_factory=DrawOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    sizes: PointSizes = field(default_factory=PointSizes)
    march: MarchOptions = field(default_factory=MarchOptions)
    growth: GrowthOptions = field(default_factory=GrowthOptions)

    def lasting(self: R, steps: int) -> R:
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(self, steps=steps)

    def build(self, capture: Capture, seed: int) -> PointModel:
        """The recipe on one capture."""
        scene = PointScene(self.cloud, self.sizes, self.march, capture, seed)
        return PointModel(self, capture, seed, scene)
