"""The image branch: what the training frames show of places on rays, joined with the points' own.

In training some rays must do *without* pictures, so that points learn to stand alone; what the
pictures add then varies less from view to view.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.1.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Rays
from sharpfield.fields.image_features import MAPS, FeatureExtractor, Merging, Mixing
from sharpfield.ops.pyramid import look_up
from sharpfield.recipes.image_sources import ImageSources, SourceOptions
from sharpfield.rendering.points import Asked


@dataclass(frozen=True)
class Prepared:
    """Pictures for the rays of one batch."""

    frames: Int64[Tensor, "u"]
    """All sources of all rays, once each."""
    source: Int64[Tensor, "b v"]
    """Those of each ray, as numbers in that list."""
    levels: list[Float[Tensor, "u _h _w _f"]]
    """The pictures and their maps."""
    alone: Bool[Tensor, "b"]
    """Rays that do without."""


class PictureBranch(nn.Module):
    """Sources, the networks that read them, and those that join them with points.

    Args:
        options: Which pictures, and how they are read.
        capture: With frames.
        feature: Width of the feature of a place.
        seed: Of the run.
        radius: Of neighbours of a place.
        quality: Of every frame; one on average.
        width: Of the network that weighs sources.
    """

    def __init__(
        self,
        options: SourceOptions,
        capture: Capture,
        feature: int,
        seed: int,
        *,
        radius: float,
        quality: Float[np.ndarray, "n"],
        width: int = 64,
    ) -> None:
        super().__init__()
        colours = capture.needed_frames.channels
        self.colours, self.options = colours, options
        self.sources = ImageSources(options, capture, radius=radius, quality=quality)
        self.extractor = FeatureExtractor(colours, seed=seed)
        looked = colours + sum(MAPS)
        self.merging = Merging(looked, feature, seed=seed, width=width)
        self.mixing = Mixing(looked, seed=seed)

    def prepare(
        self, rays: Rays, frame: Int64[Tensor, "b"], alone: Bool[Tensor, "b"], *, learning: bool
    ) -> Prepared:
        """Choose sources for rays and read their pictures.

        Args:
            rays: On one leading axis.
            frame: That each belongs to, or is nearest to.
            alone: Rays that do without pictures.
            learning: Whether a ray's own frame must not tell.
        """
        chosen = self.sources.of_rays(frame, rays.origin, rays.direction, exclude=learning)
        frames, source = torch.unique(chosen, return_inverse=True)
        levels = self.extractor(self.sources.pictures(frames))
        return Prepared(frames, source, levels, alone)

    def forward(
        self, feature: Float[Tensor, "n r"], asked: Asked, ready: Prepared
    ) -> tuple[Float[Tensor, "n r"], Float[Tensor, "n c"], Float[Tensor, "n 1"]]:
        """Features that know what pictures show, and what pictures say of the colour itself.

        Args:
            feature: Of the places, from points.
            asked: The places.
            ready: Pictures of their rays.

        Returns:
            Mixed features; sum of the sources' colours by weight; sum of these weights.
        """
        source = ready.source[asked.ray]
        shown = self.sources.show(asked.place, asked.direction, ready.frames, source)
        xy = shown.xy.floor() + 0.5 if self.options.fetch == "nearest" else shown.xy
        looked = look_up(xy.flatten(0, 1), source.flatten(), ready.levels)
        looked = looked.view(*source.shape, looked.shape[-1])
        with_pictures = ~ready.alone[asked.ray][:, None]
        merged, weight = self.merging(looked, feature, shown.change, shown.visible)
        weight = weight * with_pictures
        mixed = self.mixing(feature, merged * with_pictures)
        light = (weight[..., None] * looked[..., : self.colours]).sum(1)
        return mixed, light, weight.sum(-1, keepdim=True)
