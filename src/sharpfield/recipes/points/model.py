"""The model of recipes on neural points: a scene and, where a recipe has them, images and blur.

A batch holds patches of a few frames; patches of one pixel are pixels. The colour of a sample on a
ray comes from the neural points around it, and from images if there is an image branch.

Source: Point-NeRF (CVPR 2022), section 3; Hybrid Neural Rendering (CVPR 2023), section 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, Pixels, Terms
from sharpfield.core.protocols import Growth, PointSet
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, exponential
from sharpfield.core.seed import generator
from sharpfield.core.tone import tone_of
from sharpfield.fields.neural_points import ColourHead
from sharpfield.formation.patch_kernel import ChosenKernel, LearnedKernel
from sharpfield.formation.shutter import Pinhole
from sharpfield.losses.photometric import weighted_mse
from sharpfield.losses.regularizers import indecision
from sharpfield.recipes.points.images import ImageBranch, Prepared
from sharpfield.recipes.points.scene import PointScene, grown, missing_points
from sharpfield.rendering.points import PointRadiance, ShadedSamples
from sharpfield.sampling.pixels_and_pairs import PatchShape, draw_patches, pixel_table

if TYPE_CHECKING:  # which imports this module
    from sharpfield.recipes.point_nerf import PointNeRF


@dataclass(frozen=True)
class PatchSamplingOptions:
    """Patches of a batch. Defaults: single pixels, as published for H."""

    patches: int = 3136
    """Patches per step."""
    patch_size: int = 1
    """Side of a patch in pixels; 1 for single pixels."""
    spacing: tuple[int, int] = (1, 8)
    """Smallest and largest distance of neighbouring pixels of a patch, in pixels of the image."""
    frames: int = 1
    """Number of frames that the patches of a step come from."""
    border: int = 10
    """Width in pixels of the border of frames that is not sampled."""


class PointModel(nn.Module):
    """Neural points and the frames they explain.

    Args:
        recipe: Options of the recipe.
        capture: As read; the model stays in its world.
        seed: Random seed of the run.
        scene: The points and their networks.
        images: The image branch, if the recipe has one.
        blur: Blur of rendered patches; None takes frames as sharp.
        light: Whether blur averages linear light, or stored values.
        weight: Weight of the loss of each frame; one on average.
    """

    heaviest_step = 0

    def __init__(
        self,
        recipe: "PointNeRF",
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
        """Patches of training frames; those rendered without images apart."""
        sampling = self.recipe.sampling
        shape = PatchShape(
            sampling.patch_size,
            sampling.spacing if sampling.patch_size > 1 else (1, 1),
            sampling.border,
        )
        seen = draw_patches(
            self.table, sampling.patches, shape, frames=sampling.frames, seed=self.seed, step=step
        ).to(self.scene.device)
        if self.images is None:
            return {"frames": seen}
        made = generator(self.seed, step, "alone")
        mixed = torch.randperm(len(seen), generator=made).to(seen.device)
        alone = int(len(seen) * self.images.options.dropout)
        batch: Batch = {"frames": seen[mixed[alone:]]}
        return batch | {"alone": seen[mixed[:alone]]} if alone else batch

    def losses(self, batch: Batch, step: int) -> Terms:
        """Squared error of the pixels whose rays hit a point, and the confidence regulariser."""
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
        error = weighted_mse(colour, flat.value, self.weight[flat.frame], met.hit)
        return {"frames": error} | self._decided(met)

    def colour(self, asked: ShadedSamples, ready: Prepared | None) -> Float[Tensor, "n c"]:
        """Colour of samples on rays, as frames store it."""
        field, start = self.scene.field, None
        if self.recipe.residual_colours:
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
        """Linear light as stored values."""
        return self.tone.encode(light).clamp(0, 1)

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """Grow points beside rays that miss, and prune those of low confidence."""
        options, steps = self.recipe.growth, self.recipe.steps
        if not options.due(step, steps):
            return []
        points = self.scene.field.points
        added = missing_points(options, self.scene, self.pinhole, step) if options.grows else None
        growth = grown(options, points, added, step, steps)
        return [] if growth is None else [(points, growth)]

    def groups(self) -> list[Group]:
        """Parameters of networks and points with their learning rates."""
        recipe = self.recipe
        until = max(recipe.steps, 1)
        networks = exponential(recipe.lr, recipe.lr_final * recipe.lr, until=until)
        points = exponential(recipe.points_lr, recipe.lr_final * recipe.points_lr, until=until)
        groups = self.scene.groups(networks, points)
        for name in ("head", "images", "blur"):
            part = getattr(self, name)
            if part is not None and (own := tuple(part.parameters())):
                groups.append(Group(name, own, networks))
        return groups

    def _blurred(self, colour: Float[Tensor, "b c"], seen: Pixels, met: PointRadiance) -> Tensor:
        """Rendered patches, blurred as the recorded ones."""
        assert self.blur is not None
        patches = colour.view(*seen.value.shape)
        known = met.hit.view(seen.value.shape[:-1]).to(colour.dtype)
        if self.light == "stored":
            return self.blur(patches, seen.value, known).view(colour.shape)
        light = self.tone.decode(patches.clamp_min(0))
        blurred = self.blur(light, self.tone.decode(seen.value), known)
        return self.tone.encode(blurred.clamp_min(0)).view(colour.shape)

    def _decided(self, met: PointRadiance) -> Terms:
        """The confidence regulariser of the points that rays hit (Point-NeRF, section 4.3)."""
        if self.recipe.confidence_weight == 0:
            return {}
        taken = met.rows[met.rows >= 0].unique()
        sure = self.scene.field.points.take(taken).confidence[:, 0]
        return {"confidence_weight": self.recipe.confidence_weight * indecision(sure)}
