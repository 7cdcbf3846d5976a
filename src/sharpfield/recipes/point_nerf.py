"""Point-NeRF: a radiance field on neural points, of frames taken as sharp; baseline of `hybrid`.

Q. Xu et al., *Point-NeRF: Point-based Neural Radiance Fields*, CVPR 2022. Points from depth carry
learned descriptors; the nearest ones around a sample on a ray give its density and colour.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Paper
from sharpfield.fields.neural_points import PointSizes
from sharpfield.initialisation.point_cloud import CloudOptions
from sharpfield.recipes.points.model import PatchSamplingOptions, PointModel
from sharpfield.recipes.points.scene import GrowthOptions, MarchOptions, PointScene
from sharpfield.recipes.settings.presets import Presets, paper_of, published

R = TypeVar("R", bound="PointNeRF")


def draft(recipe: R) -> R:
    """Minutes on two CPU cores: small networks on averaged neighbours, residual colours."""
    recipe = quick(recipe, points=50_000, width=64, feature=64, pixels=1024, samples=12)
    return replace(recipe.lasting(2000), lr=2e-3, points_lr=5e-3, lr_final=0.05)


def standard(recipe: R) -> R:
    """Minutes on a GPU, hours on a CPU."""
    recipe = quick(recipe, points=1_000_000, width=128, feature=128, pixels=3136, samples=16)
    return replace(recipe.lasting(20_000), lr=1e-3, points_lr=4e-3, lr_final=0.05)


def quick(recipe: R, *, points: int, width: int, feature: int, pixels: int, samples: int) -> R:
    """Settings that learn fast without weights pre-trained on another data set."""
    patch_pixels = recipe.sampling.patch_size**2
    sampling = PatchSamplingOptions(
        patches=max(pixels // patch_pixels, 1),
        patch_size=recipe.sampling.patch_size,
        spacing=(1, 3),
        frames=8,
        border=0,
    )
    return replace(
        recipe,
        residual_colours=True,
        sampling=sampling,
        cloud=CloudOptions(
            max_points=points,
            colours="fused",
            min_depth=0.0,
            max_depth=float("inf"),
            frames="train",
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
        march=MarchOptions(voxel=0.0, steps=0, max_samples=samples, thickness=1.0, background=0.5),
        growth=GrowthOptions(every=0.1, until=0.5, max_points=2 * points),
    )


@dataclass(frozen=True)
class PointNeRF:
    """Neural points from depth; frames are taken as sharp. The baseline of `hybrid`."""

    paper: ClassVar[Paper] = paper_of("point-nerf")
    renamed: ClassVar[dict[str, str]] = {
        "cloud.budget": "cloud.max_points",
        "cloud.nearest": "cloud.min_depth",
        "cloud.farthest": "cloud.max_depth",
        "rate": "lr",
        "points_rate": "points_lr",
        "decay": "lr_final",
        "decisive": "confidence_weight",
        "start_colours": "residual_colours",
        "drawn.side": "sampling.patch_size",
        "drawn.apart": "sampling.spacing",
        "drawn": "sampling",
        "march.asked": "march.max_samples",
        "growth.share": "growth.frame_share",
        "growth.opaque": "growth.min_opacity",
        "growth.drop": "growth.prune_below",
        "growth.most": "growth.max_points",
    }
    presets: ClassVar[Presets] = Presets(
        sizes={"draft": draft, "standard": standard, "paper": published}
    )

    steps: int = 200_000
    """Length of the schedule in steps."""
    lr: float = 5e-4
    """First learning rate of the networks (Adam)."""
    points_lr: float = 2e-3
    """First learning rate of the descriptors, colours and confidences of points."""
    lr_final: float = 0.63
    """Learning rates at the end of the schedule, as a fraction of the first ones."""
    confidence_weight: float = 1e-4
    """Weight of the regulariser that drives confidences to 0 or 1."""
    residual_colours: bool = False
    """Whether the network predicts a residual of the colours of points and images, instead of the
    colour itself."""
    sampling: PatchSamplingOptions = field(default_factory=PatchSamplingOptions)
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
