"""NeRF: a radiance field of frames taken as sharp. The baseline of recipes with blur or events.

B. Mildenhall et al., *NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis*,
ECCV 2020. With `volume.kind` `planes` (factored feature volumes) or `voxels` (a dense grid) the
same method trains in minutes instead of hours.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, Pixels, Terms
from sharpfield.core.protocols import Paper
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, constant, exponential, scaled
from sharpfield.core.tone import tone_of
from sharpfield.recipes.settings.presets import Presets, paper_of, published
from sharpfield.recipes.volume.scene import (
    DRAFT,
    GRID_RATE,
    STANDARD,
    FrameModel,
    Volume,
    VolumeOptions,
)
from sharpfield.recipes.volume.terms import FrameOptions, KernelTerm


def draft(recipe: "NeRF") -> "NeRF":
    """A dense grid instead of the networks; minutes on two CPU cores."""
    return NeRF(
        steps=2000, lr=GRID_RATE, lr_decay_steps=1000, pixels=1024, volume=VolumeOptions(**DRAFT)
    )


def standard(recipe: "NeRF") -> "NeRF":
    """Factored feature volumes; minutes on a GPU."""
    volume = VolumeOptions(kind="planes", noise=0.0, density="softplus", **STANDARD)
    return NeRF(steps=10_000, lr=5e-3, lr_decay_steps=3333, tv_weight=0.02, volume=volume)


@dataclass(frozen=True)
class NeRF:
    """A radiance field of frames taken as sharp. The baseline of the volume recipes."""

    paper: ClassVar[Paper] = paper_of("nerf")
    renamed: ClassVar[dict[str, str]] = {
        "rate": "lr",
        "decay": "lr_decay_steps",
        "smooth": "tv_weight",
        "grids_faster": "grid_lr_factor",
    }
    presets: ClassVar[Presets] = Presets(
        sizes={"draft": draft, "standard": standard, "paper": published}
    )

    steps: int = 200_000
    """Length of the schedule in steps."""
    lr: float = 5e-4
    """First learning rate (Adam)."""
    grid_lr_factor: float = 1.0
    """Factor on the learning rate of planes and lines."""
    lr_decay_steps: int = 250_000
    """Steps in which the learning rate falls to a tenth."""
    tv_weight: float = 0.0
    """Weight of the total variation of planes and lines, or of the dense grid."""
    pixels: int = 1024
    """Pixels per step."""
    volume: VolumeOptions = field(
        default_factory=lambda: VolumeOptions(kind="mlp", samples=(64, 128))
    )

    def lasting(self, steps: int) -> "NeRF":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(
            self,
            steps=steps,
            lr_decay_steps=max(round(self.lr_decay_steps * steps / self.steps), 1),
        )

    def build(self, capture: Capture, seed: int) -> "Model":
        """The model of this recipe on one capture."""
        return Model(self, capture, seed)


class Model(FrameModel):
    """A radiance field and its frames, one ray per pixel."""

    heaviest_step = 0

    def __init__(self, recipe: NeRF, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe = recipe
        self.volume = Volume(recipe.volume, capture, seed)
        self.capture = self.volume.capture
        self.tone = tone_of(capture.needed_frames.encoding)
        self.frames = KernelTerm(
            FrameOptions(blur="none", pixels=recipe.pixels),
            self.volume,
            self.tone.encode,
            constant(0.0),
            blur=None,
            share=constant(0.0),
            prior=None,
        )
        self.lr = exponential(recipe.lr, recipe.lr / 10, until=recipe.lr_decay_steps)

    def draw(self, step: int) -> Batch:
        """A random batch of pixels of the training frames."""
        return {"frames": self.frames.draw(step, self.volume.device)}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Squared error of the pixels, fine and coarse, and the total variation."""
        assert isinstance(seen := batch["frames"], Pixels)
        terms = self.frames.terms(self.volume, seen, step)
        if self.recipe.tv_weight > 0:
            terms["smooth"] = self.recipe.tv_weight * self.volume.smoothness()
        return terms

    def render(self, rays: Rays) -> Radiance:
        """Linear light along rays."""
        return self.volume.view(rays)

    def groups(self) -> list[Group]:
        """Parameters of networks and grids with their learning rates."""
        return self.volume.groups(self.lr, scaled(self.lr, self.recipe.grid_lr_factor))
