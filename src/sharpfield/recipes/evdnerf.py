"""EvDNeRF: a dynamic scene from the events of several static cameras.

A. Bhattacharya et al., *EvDNeRF: Reconstructing Event Data with Dynamic Neural Radiance Fields*,
WACV 2024. The change of log intensity of a pixel in a window of time is fitted to the events that
were counted in it. Windows become shorter in the course of training (varied batching), and early
ones are opened first.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, EventPairs, Terms
from sharpfield.core.protocols import Paper
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group
from sharpfield.core.tone import luma
from sharpfield.events.threshold import thresholds_of
from sharpfield.formation.events import LogContrast
from sharpfield.formation.response import FixedResponse
from sharpfield.losses.events import dead_zone_error, scaled_error
from sharpfield.recipes.settings.presets import Presets, paper_of, published
from sharpfield.recipes.volume.moving_scenes import WarpedOptions, WarpedScene
from sharpfield.recipes.volume.scene import stages
from sharpfield.sampling.binned import BinnedTable, Halved, binned_table, draw_binned, open_windows
from sharpfield.storage.event_cache import event_index

FLOOR = 1e-10
"""Light added before the logarithm."""


@dataclass(frozen=True)
class Curriculum:
    """Curriculum of event windows (varied batching)."""

    windows: tuple[int, ...] = (31, 63, 127)
    """Number of windows that the capture is divided into, for each stage."""
    stages: tuple[int, ...] = (0, 100_000, 150_000)
    """First step of each stage."""
    crop_steps: int = 2_000
    """Steps in which only pixels in a box around the first events are sampled."""
    opening_steps: int = 20_000
    """Steps over which later and later windows are opened."""
    warmup_steps: int = 1_000
    """Steps at the beginning of each stage in which the learning rate grows from a tenth."""

    def stage(self, step: int) -> int:
        """Stage of a step."""
        return sum(step >= begin for begin in self.stages) - 1

    def lr_factor(self, step: int) -> float:
        """Factor on the learning rate."""
        since = step - self.stages[self.stage(step)]
        return min(0.1 + 0.9 * since / self.warmup_steps, 1.0)

    def lasting(self, factor: float) -> "Curriculum":
        """The same curriculum with all its steps multiplied."""

        def stretched(number: int) -> int:
            return max(round(number * factor), 1)

        return replace(
            self,
            stages=(0, *(stretched(begin) for begin in self.stages[1:])),
            crop_steps=stretched(self.crop_steps),
            opening_steps=stretched(self.opening_steps),
            warmup_steps=stretched(self.warmup_steps),
        )


def lego(recipe: "EvDNeRF") -> "EvDNeRF":
    """The paper's numbers for low contrast: a dead zone, and a tenth of the learning rate."""
    return replace(recipe, lr=recipe.lr / 10, dead_zone=True)


def real(recipe: "EvDNeRF") -> "EvDNeRF":
    """The paper's numbers for real data: two networks, no compression of log intensity."""
    curriculum = replace(
        recipe.curriculum, windows=(99,), stages=(0,), crop_steps=5_000, opening_steps=30_000
    )
    scene = replace(recipe.scene, networks=2)
    return replace(recipe, steps=50_000, gamma=0.0, curriculum=curriculum, scene=scene)


def draft(recipe: "EvDNeRF") -> "EvDNeRF":
    """Smaller networks, fewer pixels, a higher learning rate; minutes on two CPU cores."""
    scene = replace(recipe.scene, width=64, depth=6, samples=(24, 24))
    return replace(recipe.lasting(2000), lr=10 * recipe.lr, pairs=128, scene=scene)


def standard(recipe: "EvDNeRF") -> "EvDNeRF":
    """Half as wide and a tenth as long; for a GPU."""
    scene = replace(recipe.scene, width=128, samples=(48, 64))
    return replace(recipe.lasting(20_000), lr=5 * recipe.lr, scene=scene)


@dataclass(frozen=True)
class EvDNeRF:
    """A dynamic scene from events of static cameras. Defaults: the paper's simulated scenes."""

    paper: ClassVar[Paper] = paper_of("evdnerf")
    renamed: ClassVar[dict[str, str]] = {
        "rate": "lr",
        "one_scale": "fixed_scale",
        "curriculum.crop": "curriculum.crop_steps",
        "curriculum.times": "curriculum.opening_steps",
        "curriculum.warm_up": "curriculum.warmup_steps",
    }
    presets: ClassVar[Presets] = Presets(
        variants={"lego": lego, "real": real},
        sizes={"draft": draft, "standard": standard, "paper": published},
    )

    steps: int = 200_000
    """Length of the schedule in steps."""
    lr: float = 1e-4
    """Learning rate after each warm-up (Adam)."""
    pairs: int = 1024
    """Pixels per step, each of a random event frame."""
    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter, natural log; None takes that of the capture,
    or 0.2."""
    gamma: float = 2.2
    """Compression of log intensity: the predicted change is divided by this, the measured one by
    its largest value; 0 divides both by the latter, without compression."""
    dead_zone: bool = False
    """Whether differences within one threshold cost nothing, published for low-contrast data; no
    compression then."""
    halved: Halved = "no"
    """Whether events of 2x2 pixels are summed to half the resolution, fairly or as released."""
    fixed_scale: bool = False
    """Whether the largest change is that of the first stage in all stages; released: of each stage,
    so that the scale of the learned log intensity jumps."""
    coarse_loss: bool = False
    """Whether the coarse one of two networks has a loss; it never has in the released code."""
    curriculum: Curriculum = field(default_factory=Curriculum)
    scene: WarpedOptions = field(default_factory=WarpedOptions)

    def lasting(self, steps: int) -> "EvDNeRF":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        curriculum = self.curriculum.lasting(steps / self.steps)
        return replace(self, steps=steps, curriculum=curriculum)

    def build(self, capture: Capture, seed: int) -> "Model":
        """The model of this recipe on one capture."""
        return Model(self, capture, seed)


class Model(nn.Module):
    """A dynamic scene and its event frames; frames are not used."""

    heaviest_step = 0

    def __init__(self, recipe: EvDNeRF, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.seed = recipe, seed
        capture.needed_events  # noqa: B018 (raises where there are none)
        self.scene = WarpedScene(recipe.scene, capture.without(frames=True), seed)
        self.capture = self.scene.capture
        self.threshold = thresholds_of(capture, recipe.threshold)
        index = event_index(self.capture.needed_events)
        self.tables: list[BinnedTable] = [
            binned_table(index, capture.clock, windows, capture.camera.size, halved=recipe.halved)
            for windows in recipe.curriculum.windows
        ]
        path = self.capture.trajectory
        self.sensor = LogContrast(self.capture.camera, path, FixedResponse(floor=FLOOR))

    def draw(self, step: int) -> Batch:
        """Pixels of the open windows of this stage: half with events, half any."""
        curriculum, table = self.recipe.curriculum, self._table(step)
        seen = draw_binned(
            table,
            self.recipe.pairs,
            seed=self.seed,
            step=step,
            until=open_windows(step, table.net.shape[1], curriculum.opening_steps),
            cropped=step < curriculum.crop_steps,
            device=self.scene.device,
        )
        return {"events": seen}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Error of the change of log intensity in each window."""
        assert isinstance(seen := batch["events"], EventPairs)
        light = self.scene.sharp(self.sensor.expose(seen), step, "events")
        levels = stages(light) if self.recipe.coarse_loss else [light]
        errors = [
            self.error(self.sensor.observe(stage, seen)[:, 0], seen, step) for stage in levels
        ]
        return {"events": torch.stack(errors).sum()}

    def error(
        self, predicted: Float[Tensor, "b"], seen: EventPairs, step: int
    ) -> Float[Tensor, ""]:
        """Error of predicted changes against counted events."""
        measured = seen.measured(*self.threshold)
        if self.recipe.dead_zone:
            return dead_zone_error(predicted, measured, sum(self.threshold) / 2)
        largest = self.largest_change(step)
        return scaled_error(
            predicted, measured, scale=self.recipe.gamma or largest, measured_scale=largest
        )

    def largest_change(self, step: int) -> float:
        """Largest measured change in the stage of a step, natural log."""
        table = self.tables[0] if self.recipe.fixed_scale else self._table(step)
        return max(table.most, 1) * max(self.threshold)

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """Log intensity of the event camera after the last stage, the compression undone."""
        log = (luma(light) + FLOOR).log()
        if self.recipe.dead_zone or not self.recipe.gamma:
            return log
        return log * (self.largest_change(self.recipe.steps) / self.recipe.gamma)

    def render(self, rays: Rays) -> Radiance:
        """Light along rays, known up to a power and a factor."""
        return self.scene.view(rays)

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """Light as it is: there are no frames whose encoding could be applied."""
        return light.clamp(0, 1)

    def groups(self) -> list[Group]:
        """Parameters of all networks with their learning rate."""
        recipe = self.recipe
        return self.scene.groups(lambda step: recipe.lr * recipe.curriculum.lr_factor(step))

    def _table(self, step: int) -> BinnedTable:
        return self.tables[self.recipe.curriculum.stage(step)]
