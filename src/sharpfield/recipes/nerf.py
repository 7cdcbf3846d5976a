"""NeRF: a sharp scene from frames taken as they are. The baseline that blur and events must beat.

B. Mildenhall et al., *NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis*,
ECCV 2020. With `volume.kind` "planes" or "voxels" the same method on factored feature volumes or a
dense grid, which learn in minutes what the large networks learn in hours.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, Pixels
from sharpfield.core.paper import Paper
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, constant, exponential, scaled
from sharpfield.core.tone import tone_of
from sharpfield.recipes.settings.presets import Presets
from sharpfield.recipes.volume.frame_terms import FrameOptions, KernelTerm, Terms
from sharpfield.recipes.volume.scene import DRAFT, GRID_RATE, STANDARD, Volume, VolumeOptions

PAPER = Paper(
    key="mildenhall2020nerf",
    title="NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis",
    bibtex="""@inproceedings{mildenhall2020nerf,
  title     = {{NeRF}: Representing Scenes as Neural Radiance Fields for View Synthesis},
  author    = {Mildenhall, Ben and Srinivasan, Pratul P. and Tancik, Matthew and
               Barron, Jonathan T. and Ramamoorthi, Ravi and Ng, Ren},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year      = {2020}
}""",
    departures=(
        "The scene is linear light and frames are encoded by their own response; the published"
        " code works on stored values throughout.",
        "In evaluation, colour is left out where a sample sends less than 1e-4 of a ray's light.",
    ),
)


def draft(recipe: "NeRF") -> "NeRF":
    """A dense grid instead of large networks; minutes on two CPU cores."""
    return NeRF(steps=2000, rate=GRID_RATE, decay=1000, pixels=1024, volume=VolumeOptions(**DRAFT))


def standard(recipe: "NeRF") -> "NeRF":
    """Planes; minutes on a GPU."""
    volume = VolumeOptions(kind="planes", noise=0.0, density="softplus", **STANDARD)
    return NeRF(steps=10_000, rate=5e-3, decay=3333, smooth=0.02, volume=volume)


def published(recipe: "NeRF") -> "NeRF":
    """The published networks and length."""
    return NeRF()


@dataclass(frozen=True)
class NeRF:
    """Frames to a scene, blur and all."""

    paper: ClassVar[Paper] = PAPER
    presets: ClassVar[Presets] = Presets(
        sizes={"draft": draft, "standard": standard, "paper": published}
    )

    steps: int = 200_000
    """Length of the schedule."""
    rate: float = 5e-4
    """First learning rate."""
    grids_faster: float = 1.0
    """Factor on the rate of planes and lines."""
    decay: int = 250_000
    """Steps in which it falls to a tenth."""
    smooth: float = 0.0
    """Weight of the total variation of planes and lines."""
    pixels: int = 1024
    """Drawn per step."""
    volume: VolumeOptions = field(
        default_factory=lambda: VolumeOptions(kind="mlp", samples=(64, 128))
    )

    def lasting(self, steps: int) -> "NeRF":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(self, steps=steps, decay=max(round(self.decay * steps / self.steps), 1))

    def build(self, capture: Capture, seed: int) -> "Model":
        """The recipe on one capture."""
        return Model(self, capture, seed)


class Model(nn.Module):
    """A field and the frames it explains, one ray per pixel."""

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
            trusted=constant(0.0),
            prior=None,
        )
        self.rate = exponential(recipe.rate, recipe.rate / 10, until=recipe.decay)

    def draw(self, step: int) -> Batch:
        """Pixels of the training frames."""
        return {"frames": self.frames.draw(step, self.volume.device)}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Error of the pixels, fine and coarse."""
        assert isinstance(seen := batch["frames"], Pixels)
        terms = self.frames.terms(self.volume, seen, step)
        if self.recipe.smooth > 0:
            terms["smooth"] = self.recipe.smooth * self.volume.smoothness()
        return terms

    def render(self, rays: Rays) -> Radiance:
        """Linear light."""
        return self.volume.view(rays)

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """As the frames store it."""
        return self.tone.encode(light).clamp(0, 1)

    def groups(self) -> list[Group]:
        """Networks and grids at one rate."""
        return self.volume.groups(self.rate, scaled(self.rate, self.recipe.grids_faster))
