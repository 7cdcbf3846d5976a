"""D-NeRF: a dynamic scene from frames. The baseline for events where frames are blurred or few.

A. Pumarola et al., *D-NeRF: Neural Radiance Fields for Dynamic Scenes*, CVPR 2021. Frames may come
from anywhere: a camera, another model's renders, or a network that makes images of events; see
`sharpfield ingest` and the layout `d-nerf`.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, Pixels, Terms
from sharpfield.core.protocols import Paper
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, exponential
from sharpfield.core.tone import tone_of
from sharpfield.formation.shutter import Shutter
from sharpfield.losses.photometric import mse
from sharpfield.recipes.settings.presets import Presets, paper_of, published
from sharpfield.recipes.volume.moving_scenes import WarpedOptions, WarpedScene
from sharpfield.recipes.volume.scene import FrameModel, stages
from sharpfield.sampling.pixels_and_pairs import draw_pixels, pixel_table


def draft(recipe: "DNeRF") -> "DNeRF":
    """Smaller networks, fewer pixels, a higher learning rate; minutes on two CPU cores."""
    scene = replace(recipe.scene, width=64, depth=6, samples=(24, 24))
    return replace(recipe.lasting(2000), lr=2e-3, pixels=256, scene=scene)


def standard(recipe: "DNeRF") -> "DNeRF":
    """Half as wide; for a GPU."""
    scene = replace(recipe.scene, width=128, samples=(48, 64))
    return replace(recipe.lasting(40_000), lr=1e-3, pixels=1024, scene=scene)


@dataclass(frozen=True)
class DNeRF:
    """A dynamic scene from frames: a canonical radiance field and a deformation field."""

    paper: ClassVar[Paper] = paper_of("d-nerf")
    renamed: ClassVar[dict[str, str]] = {"rate": "lr", "decay": "lr_decay_steps"}
    presets: ClassVar[Presets] = Presets(
        sizes={"draft": draft, "standard": standard, "paper": published}
    )

    steps: int = 800_000
    """Length of the schedule in steps."""
    lr: float = 5e-4
    """First learning rate (Adam)."""
    lr_decay_steps: int = 500_000
    """Steps in which the learning rate falls to a tenth."""
    pixels: int = 500
    """Pixels per step."""
    instants: int = 1
    """Instants of a blurred exposure that are averaged; 1 takes frames as sharp."""
    scene: WarpedOptions = field(
        default_factory=lambda: WarpedOptions(
            colours=3, networks=2, density="relu", opaque_end=False, shared_jitter=True
        )
    )

    def lasting(self, steps: int) -> "DNeRF":
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
    """A dynamic scene and its frames; events are not used."""

    heaviest_step = 0

    def __init__(self, recipe: DNeRF, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.seed = recipe, seed
        frames = capture.needed_frames
        self.scene = WarpedScene(recipe.scene, capture, seed)
        self.capture = self.scene.capture
        self.tone = tone_of(frames.encoding)
        self.pixels = pixel_table(self.capture)
        instants = 1 if frames.exposure.instant.all() else recipe.instants
        camera, path = self.capture.camera, self.capture.trajectory
        self.shutter = Shutter(camera, path, instants, self.tone.encode)
        self.lr = exponential(recipe.lr, recipe.lr / 10, until=recipe.lr_decay_steps)

    def draw(self, step: int) -> Batch:
        """A random batch of pixels of the training frames."""
        return {
            "frames": draw_pixels(
                self.pixels, self.recipe.pixels, seed=self.seed, step=step, device=self.scene.device
            )
        }

    def losses(self, batch: Batch, step: int) -> Terms:
        """Squared error of the pixels, coarse and fine."""
        assert isinstance(seen := batch["frames"], Pixels)
        light = self.scene.sharp(self.shutter.expose(seen), step, "frames")
        names = ("coarse", "fine") if light.coarse is not None else ("fine",)
        return {
            name: mse(self.shutter.observe(stage, seen), seen.value)
            for name, stage in zip(names, reversed(stages(light)), strict=True)
        }

    def render(self, rays: Rays) -> Radiance:
        """Linear light along rays."""
        return self.scene.view(rays)

    def groups(self) -> list[Group]:
        """Parameters of all networks with their learning rate."""
        return self.scene.groups(self.lr)
