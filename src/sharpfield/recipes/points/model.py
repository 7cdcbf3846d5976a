"""The model of recipes on neural points: a scene and, where a recipe has them, images and blur.

A step looks at patches of a few frames; patches of one pixel are pixels. The colour of a place
comes from its points, and from images if there is a branch for them.

How much each frame of a capture counts, for how sharp it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, Pixels
from sharpfield.core.points import Growth
from sharpfield.core.protocols import PointSet
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, exponential
from sharpfield.core.seed import generator
from sharpfield.core.tone import tone_of
from sharpfield.fields.points.networks import ColourHead, PointSizes
from sharpfield.formation.patch_kernel import ChosenKernel, LearnedKernel
from sharpfield.formation.shutter import Pinhole
from sharpfield.initialisation.point_cloud import CloudOptions
from sharpfield.losses.regularizers import indecision
from sharpfield.recipes.points.growth import GrowthOptions, grown, missing_points
from sharpfield.recipes.points.images import ImageBranch, Prepared
from sharpfield.recipes.points.scene import MarchOptions, PointScene
from sharpfield.rendering.points import Asked, Met
from sharpfield.sampling.patches import PatchShape, draw_patches
from sharpfield.sampling.pixels_and_pairs import pixel_table

Terms = dict[str, Tensor]


@dataclass(frozen=True)
class DrawOptions:
    """What a step looks at. Defaults: single pixels, as published for H."""

    patches: int = 3136
    """Drawn per step."""
    side: int = 1
    """Pixels along the edge of each; 1 for single pixels."""
    apart: tuple[int, int] = (1, 8)
    """Fewest and most pixels from one pixel of a patch to the next."""
    frames: int = 1
    """From which the patches of a step come."""
    border: int = 10
    """Pixels at the edge of frames that are not learned from."""


@runtime_checkable
class PointNumbers(Protocol):
    """The numbers of a recipe on points."""

    @property
    def steps(self) -> int:
        """Length of the schedule."""
        ...

    @property
    def rate(self) -> float:
        """First learning rate of networks."""
        ...

    @property
    def points_rate(self) -> float:
        """First learning rate of points."""
        ...

    @property
    def decay(self) -> float:
        """What is left of the rates at the end."""
        ...

    @property
    def decisive(self) -> float:
        """Weight of the term that makes confidences 0 or 1."""
        ...

    @property
    def start_colours(self) -> bool:
        """Whether the network adds to known colours."""
        ...

    @property
    def drawn(self) -> DrawOptions:
        """What a step looks at."""
        ...

    @property
    def cloud(self) -> CloudOptions:
        """Where points come from."""
        ...

    @property
    def sizes(self) -> PointSizes:
        """Of the networks."""
        ...

    @property
    def march(self) -> MarchOptions:
        """How rays run."""
        ...

    @property
    def growth(self) -> GrowthOptions:
        """How points become more, and fewer."""
        ...


class PointModel(nn.Module):
    """Neural points and the frames they explain.

    Args:
        recipe: With its numbers.
        capture: As read; the model stays in its world.
        seed: Of the run.
        scene: The points and their networks.
        images: What training frames add, if anything.
        blur: From rendered patches to recorded ones; None if frames are taken as they are.
        light: Whether blur adds up light, or what frames store.
        weight: How much each frame counts; one on average.
    """

    heaviest_step = 0

    def __init__(
        self,
        recipe: PointNumbers,
        capture: Capture,
        seed: int,
        scene: PointScene,
        *,
        images: ImageBranch | None = None,
        blur: ChosenKernel | LearnedKernel | None = None,
        light: Literal["stored", "linear"] = "stored",
        weight: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        super().__init__()
        self.recipe, self.capture, self.seed = recipe, capture, seed
        frames = capture.needed_frames
        self.tone = tone_of(frames.encoding)
        self.table = pixel_table(capture)
        self.scene, self.images, self.blur, self.light = scene, images, blur, light
        self.head = ColourHead(recipe.sizes.feature, frames.channels, seed=seed)
        self.pinhole = Pinhole(capture.camera, capture.trajectory)
        even = np.ones(len(frames)) if weight is None else weight
        self.register_buffer("weight", torch.as_tensor(even).float(), persistent=False)

    weight: Tensor

    def draw(self, step: int) -> Batch:
        """Patches of training frames, apart from those that must do without images."""
        drawn = self.recipe.drawn
        shape = PatchShape(drawn.side, drawn.apart if drawn.side > 1 else (1, 1), drawn.border)
        seen = draw_patches(
            self.table, drawn.patches, shape, frames=drawn.frames, seed=self.seed, step=step
        ).to(self.scene.device)
        if self.images is None:
            return {"frames": seen}
        made = generator(self.seed, step, "alone")
        mixed = torch.randperm(len(seen), generator=made).to(seen.device)
        alone = int(len(seen) * self.images.options.drop)
        batch: Batch = {"frames": seen[mixed[alone:]]}
        return batch | {"alone": seen[mixed[:alone]]} if alone else batch

    def losses(self, batch: Batch, step: int) -> Terms:
        """Error of the pixels whose rays met a point, and indecision of the points."""
        parts = [part for part in batch.values() if isinstance(part, Pixels)]
        seen = Pixels.cat(parts)
        flat = seen.reshape(-1)
        rays = self.pinhole.expose(flat)[:, 0]
        ready = None
        if self.images is not None:
            alone = torch.arange(len(seen), device=seen.device) >= len(parts[0])
            alone = alone.repeat_interleave(seen.shape[1] * seen.shape[2])
            ready = self.images.prepare(rays, flat.frame, alone, learning=True)
        met = self.scene.meet(
            rays, lambda asked: self.colour(asked, ready), frame=flat.frame, step=step
        )
        colour = met.colour
        if self.blur is not None:
            colour = self._blurred(colour, seen, met)
        error = (colour - flat.value).square().mean(-1) * self.weight[flat.frame] * met.hit
        terms = {"frames": error.sum() / met.hit.sum().clamp_min(1)}
        return terms | self._decided(met)

    def colour(self, asked: Asked, ready: Prepared | None) -> Float[Tensor, "n c"]:
        """Of places on rays, as frames store it."""
        field, start = self.scene.field, None
        if self.recipe.start_colours:
            start = field.mean_colour(asked.rows, asked.way)
        feature = field.feature(asked.hidden, asked.direction)
        if self.images is not None and ready is not None:
            feature, light, weight = self.images(feature, asked, ready)
            if start is not None:  # points count as one more image
                start = (start + light) / (1 + weight)
        return self.head(feature, start)

    def render(self, rays: Rays) -> Radiance:
        """Sharp linear light."""
        flat = rays.reshape(-1)
        frame, ready = self.scene.frame_at(flat.time), None
        if self.images is not None:
            alone = torch.zeros_like(frame, dtype=torch.bool)
            ready = self.images.prepare(flat, frame, alone, learning=False)
        met = self.scene.meet(flat, lambda asked: self.colour(asked, ready), frame=frame)
        light = self.tone.decode(met.colour.clamp(0, 1))
        return Radiance(light, met.depth, met.opacity, flat.weight).reshape(*rays.shape)

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """As the frames store it."""
        return self.tone.encode(light).clamp(0, 1)

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """Points where rays that find something opaque border on rays that miss."""
        options, steps = self.recipe.growth, self.recipe.steps
        if not options.due(step, steps):
            return []
        points = self.scene.field.points
        added = missing_points(options, self.scene, self.pinhole, step) if options.grows else None
        growth = grown(options, points, added, step, steps)
        return [] if growth is None else [(points, growth)]

    def groups(self) -> list[Group]:
        """Networks and points."""
        recipe = self.recipe
        until = max(recipe.steps, 1)
        networks = exponential(recipe.rate, recipe.decay * recipe.rate, until=until)
        points = exponential(recipe.points_rate, recipe.decay * recipe.points_rate, until=until)
        groups = self.scene.groups(networks, points)
        for name in ("head", "images", "blur"):
            part = getattr(self, name)
            if part is not None and (own := tuple(part.parameters())):
                groups.append(Group(name, own, networks))
        return groups

    def _blurred(self, colour: Float[Tensor, "b c"], seen: Pixels, met: Met) -> Tensor:
        """Rendered patches as the frames may have recorded them."""
        assert self.blur is not None
        patches = colour.view(*seen.value.shape)
        known = met.hit.view(seen.value.shape[:-1]).to(colour.dtype)
        if self.light == "stored":
            return self.blur(patches, seen.value, known).view(colour.shape)
        light = self.tone.decode(patches.clamp_min(0))
        blurred = self.blur(light, self.tone.decode(seen.value), known)
        return self.tone.encode(blurred.clamp_min(0)).view(colour.shape)

    def _decided(self, met: Met) -> Terms:
        """The term on the confidences of the points that rays met."""
        if self.recipe.decisive == 0:
            return {}
        taken = met.rows[met.rows >= 0].unique()
        sure = self.scene.field.points.take(taken).confidence[:, 0]
        return {"decisive": self.recipe.decisive * indecision(sure)}
