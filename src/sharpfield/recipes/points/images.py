"""The image branch: what the training frames show of places on rays, joined with the points' own.

In training some rays must do *without* images, so that points learn to stand alone; what the
images add then varies less from view to view.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.1.

Which images tell about places on a ray, and where in them: sources, projection, visibility.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.frames import DepthMaps
from sharpfield.core.rays import Rays
from sharpfield.fields.image_features import MAPS, FeatureExtractor, Merging, Mixing
from sharpfield.ops.pyramid import look_up
from sharpfield.rendering.points import Asked

AHEAD = 1e-6
"""Least depth of what a image shows."""

APART = 0.25
"""Cameras this share of the largest depth apart count as looking in orthogonal directions."""

EQUAL = 0.02
"""Differences below this do not decide between sources when they are of different quality."""


@dataclass(frozen=True)
class SourceOptions:
    """Images beside the points. Defaults: Hybrid Neural Rendering's."""

    count: int = 4
    """Asked about each place; 0 for none."""
    choose: Literal["order", "pose"] = "order"
    """Those nearest in the order of frames, as published, or those whose cameras stand near and
    look along a ray."""
    fetch: Literal["nearest", "bilinear"] = "nearest"
    """Whole pixels, as published, or between them."""
    visibility: Literal["none", "depth"] = "none"
    """Whether what a image does not show is told by its network alone, as published, or by
    depth."""
    slack: float = 1.0
    """How far behind the measured depth a place still counts as visible, in radii of neighbours."""
    drop: float = 0.5
    """Share of the rays that must do without images in training."""
    trust: float = 0.0
    """Power of a image's quality that its weight is multiplied by; 0 as published."""
    prefer: float = 0.0
    """Power of a image's quality when sources are chosen by pose."""


@dataclass(frozen=True)
class Shown:
    """Where places are in their sources."""

    source: Int64[Tensor, "n v"]
    """Number in the list of images that were prepared."""
    xy: Float[Tensor, "n v 2"]
    """In pixels."""
    change: Float[Tensor, "n v 3"]
    """Unit direction from the source to the place, minus that of the ray."""
    visible: Float[Tensor, "n v"]
    """0...1; 0 outside of the image and behind the camera."""


class ImageSources(nn.Module):
    """The training frames of a capture as sources.

    Args:
        options: Which of them, and how they are read.
        capture: With frames.
        radius: Of neighbours of a place.
        quality: Of every frame; one on average.
    """

    poses: Tensor
    learned: Tensor
    quality: Tensor
    by_order: Tensor

    def __init__(
        self,
        options: SourceOptions,
        capture: Capture,
        *,
        radius: float,
        quality: Float[np.ndarray, "n"],
    ) -> None:
        super().__init__()
        self.options, self.capture, self.radius = options, capture, radius
        frames, train = capture.needed_frames, capture.split.train
        self.images, self.white = frames.images, frames.white
        every = np.arange(len(frames))
        tables = {
            "poses": capture.frame_pose(every).detach().float(),
            "learned": torch.as_tensor(train),
            "quality": torch.as_tensor(quality).float(),
            "by_order": torch.from_numpy(nearest_in_order(len(frames), train, options.count)),
        }
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)
        self.depth: DepthMaps | None = capture.depth if options.visibility == "depth" else None

    def of_rays(
        self,
        frame: Int64[Tensor, "b"],
        origin: Float[Tensor, "b 3"],
        direction: Float[Tensor, "b 3"],
        *,
        exclude: bool,
    ) -> Int64[Tensor, "b v"]:
        """The frames that tell about rays, best first.

        Args:
            frame: That rays belong to, or are nearest to in time.
            origin: Of rays.
            direction: Unit length.
            exclude: Whether a ray's own frame may not tell, as while training. By order it never
                does.
        """
        if self.options.choose == "order":
            return self.by_order[frame]
        pose = self.poses[self.learned]
        apart = torch.cdist(origin, pose[:, :, 3]) / (APART * self.capture.far)
        score = apart + 1 - direction @ pose[:, :, 2].T + EQUAL
        score = score / self.quality[self.learned].clamp_min(1e-3) ** self.options.prefer
        if exclude:
            score = torch.where(self.learned == frame[:, None], torch.inf, score)
        count = min(self.options.count, len(self.learned) - 1)
        return self.learned[score.topk(count, largest=False).indices]

    def frame_images(self, frames: Int64[Tensor, "u"]) -> Float[Tensor, "u h w c"]:
        """Some frames as stored, 0...1."""
        held = [np.asarray(self.images[i]) for i in frames.tolist()]
        stored = torch.from_numpy(np.stack(held).astype(np.float32) / np.float32(self.white))
        return stored.to(self.poses.device)

    def show(
        self,
        places: Float[Tensor, "n 3"],
        direction: Float[Tensor, "n 3"],
        frames: Int64[Tensor, "u"],
        source: Int64[Tensor, "n v"],
    ) -> Shown:
        """Where places are in their sources.

        Args:
            places: In the world.
            direction: Of the ray each is on.
            frames: The images that were prepared.
            source: Number of each place's sources in that list.
        """
        pose = self.poses[frames][source]  # [n, v, 3, 4]
        way = places[:, None] - pose[..., 3]
        seen = (way[..., None] * pose[..., :3]).sum(-2)  # R^T way; a product of matrices is slower
        ahead = seen[..., 2] > AHEAD
        safe = torch.where(ahead[..., None], seen, seen.new_tensor([0.0, 0.0, 1.0]))
        camera = self.capture.camera
        xy = camera.project(safe)
        inside = ahead & ((xy >= 0) & (xy < xy.new_tensor(camera.size))).all(-1)
        visible = inside.float()
        if self.depth is not None:
            visible = visible * self._uncovered(safe, frames, source, inside)
        if self.options.trust:
            visible = visible * self.quality[frames][source] ** self.options.trust
        unit = torch.nn.functional.normalize(direction, dim=-1)[:, None]
        change = torch.nn.functional.normalize(way, dim=-1) - unit
        return Shown(source, xy, change, visible)

    def _uncovered(
        self,
        seen: Float[Tensor, "n v 3"],
        frames: Int64[Tensor, "u"],
        source: Int64[Tensor, "n v"],
        inside: Bool[Tensor, "n v"],
    ) -> Float[Tensor, "n v"]:
        """One where a place is not behind what the depth camera measured, falling to zero."""
        assert self.depth is not None
        maps = np.stack([self.depth.at(i) for i in frames.tolist()])
        measured = torch.from_numpy(maps).to(seen.device)
        size = seen.new_tensor(self.depth.camera.size)
        xy = self.depth.camera.project(seen)
        within = inside & ((xy >= 0) & (xy < size)).all(-1)
        x, y = torch.where(within[..., None], xy, 0).long().unbind(-1)
        there = measured[source, y, x]
        slack = self.options.slack * self.radius
        behind = (seen[..., 2] - there - slack).clamp_min(0) / slack
        return torch.where(within & (there > 0), torch.exp(-behind), 1.0)


def nearest_in_order(
    frames: int, train: Int64[np.ndarray, "a"], count: int
) -> Int64[np.ndarray, "n v"]:
    """For every frame the training frames nearest in order, itself left out; earlier ones first.

    Args:
        frames: How many there are.
        train: Those that are learned from.
        count: Wanted; fewer if there are not so many.
    """
    away = np.abs(np.arange(frames)[:, None] - train).astype(np.float64)
    away[away == 0] = np.inf
    count = min(count, len(train) - 1)
    return train[np.argsort(away, axis=1, kind="stable")[:, :count]]


@dataclass(frozen=True)
class Prepared:
    """Images for the rays of one batch."""

    frames: Int64[Tensor, "u"]
    """All sources of all rays, once each."""
    source: Int64[Tensor, "b v"]
    """Those of each ray, as numbers in that list."""
    levels: list[Float[Tensor, "u _h _w _f"]]
    """The images and their maps."""
    alone: Bool[Tensor, "b"]
    """Rays that do without."""


class ImageBranch(nn.Module):
    """Sources, the networks that read them, and those that join them with points.

    Args:
        options: Which images, and how they are read.
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
        """Choose sources for rays and read their images.

        Args:
            rays: On one leading axis.
            frame: That each belongs to, or is nearest to.
            alone: Rays that do without images.
            learning: Whether a ray's own frame must not tell.
        """
        chosen = self.sources.of_rays(frame, rays.origin, rays.direction, exclude=learning)
        frames, source = torch.unique(chosen, return_inverse=True)
        levels = self.extractor(self.sources.frame_images(frames))
        return Prepared(frames, source, levels, alone)

    def forward(
        self, feature: Float[Tensor, "n r"], asked: Asked, ready: Prepared
    ) -> tuple[Float[Tensor, "n r"], Float[Tensor, "n c"], Float[Tensor, "n 1"]]:
        """Features that know what images show, and what images say of the colour itself.

        Args:
            feature: Of the places, from points.
            asked: The places.
            ready: Images of their rays.

        Returns:
            Mixed features; sum of the sources' colours by weight; sum of these weights.
        """
        source = ready.source[asked.ray]
        shown = self.sources.show(asked.place, asked.direction, ready.frames, source)
        xy = shown.xy.floor() + 0.5 if self.options.fetch == "nearest" else shown.xy
        looked = look_up(xy.flatten(0, 1), source.flatten(), ready.levels)
        looked = looked.view(*source.shape, looked.shape[-1])
        with_images = ~ready.alone[asked.ray][:, None]
        merged, weight = self.merging(looked, feature, shown.change, shown.visible)
        weight = weight * with_images
        mixed = self.mixing(feature, merged * with_images)
        light = (weight[..., None] * looked[..., : self.colours]).sum(1)
        return mixed, light, weight.sum(-1, keepdim=True)
