"""The image branch: features of nearby training frames, fused with those of the neural points.

Every sample on a ray is projected into a few *source* frames, whose features are weighted by a
network and mixed with the feature of the points. In training a part of the rays does without images
(dropout), so that points learn to stand alone; what images add then varies less between views.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.1.
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
from sharpfield.ops.pyramid import sample_pyramid
from sharpfield.rendering.points import ShadedSamples

MIN_DEPTH = 1e-6
"""Least depth of a sample in a source image."""

BASELINE = 0.25
"""Cameras this share of the largest depth apart count as looking in orthogonal directions."""

EQUAL = 0.02
"""Differences below this do not decide between sources when they are of different quality."""


@dataclass(frozen=True)
class SourceOptions:
    """Source images. Defaults: Hybrid Neural Rendering's."""

    count: int = 4
    """Source images of each sample; 0 turns the image branch off."""
    selection: Literal["order", "pose"] = "order"
    """Selection of source images: `order` takes the nearest in the order of frames, as published;
    `pose` those whose cameras are near and look along the ray."""
    interpolation: Literal["nearest", "bilinear"] = "nearest"
    """Interpolation of source images: nearest pixel, as published, or bilinear."""
    visibility: Literal["none", "depth"] = "none"
    """Visibility of a sample in a source image: left to the network (`none`), as published, or by
    measured depth."""
    depth_tolerance: float = 1.0
    """Distance behind the measured depth at which a sample still counts as visible, in radii of
    neighbours."""
    dropout: float = 0.5
    """Fraction of the rays that are rendered without images in training."""
    quality_power: float = 0.0
    """Exponent of the quality of a source image in its weight; 0 as published."""
    selection_quality_power: float = 0.0
    """Exponent of the quality of a source image in the selection by pose."""


@dataclass(frozen=True)
class Projection:
    """Projections of samples into their source images."""

    source: Int64[Tensor, "n v"]
    """Number in the list of images that were prepared."""
    xy: Float[Tensor, "n v 2"]
    """In pixels."""
    change: Float[Tensor, "n v 3"]
    """Unit direction from the source camera to the sample, minus that of the ray."""
    visible: Float[Tensor, "n v"]
    """0...1; 0 outside of the image and behind the camera."""


class ImageSources(nn.Module):
    """The training frames of a capture as sources.

    Args:
        options: Selection and interpolation.
        capture: With frames.
        radius: Radius of the neighbours of a sample, in world units.
        quality: Quality of every frame; one on average.
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
        """The source frames of rays, best first.

        Args:
            frame: Frame of each ray, or the one nearest in time.
            origin: Origins of the rays.
            direction: Unit directions of the rays.
            exclude: Whether to leave out the frame of the ray itself, as in training. Selection by
                order always does.
        """
        if self.options.selection == "order":
            return self.by_order[frame]
        pose = self.poses[self.learned]
        apart = torch.cdist(origin, pose[:, :, 3]) / (BASELINE * self.capture.far)
        score = apart + 1 - direction @ pose[:, :, 2].T + EQUAL
        score = (
            score
            / self.quality[self.learned].clamp_min(1e-3) ** self.options.selection_quality_power
        )
        if exclude:
            score = torch.where(self.learned == frame[:, None], torch.inf, score)
        count = min(self.options.count, len(self.learned) - 1)
        return self.learned[score.topk(count, largest=False).indices]

    def frame_images(self, frames: Int64[Tensor, "u"]) -> Float[Tensor, "u h w c"]:
        """Some frames as stored, 0...1."""
        held = [np.asarray(self.images[i]) for i in frames.tolist()]
        stored = torch.from_numpy(np.stack(held).astype(np.float32) / np.float32(self.white))
        return stored.to(self.poses.device)

    def project(
        self,
        positions: Float[Tensor, "n 3"],
        direction: Float[Tensor, "n 3"],
        frames: Int64[Tensor, "u"],
        source: Int64[Tensor, "n v"],
    ) -> Projection:
        """Project samples into their source images.

        Args:
            positions: Positions of the samples in the world.
            direction: Directions of their rays.
            frames: The images that were prepared.
            source: Sources of each sample, as numbers in that list.
        """
        pose = self.poses[frames][source]  # [n, v, 3, 4]
        way = positions[:, None] - pose[..., 3]
        seen = (way[..., None] * pose[..., :3]).sum(-2)  # R^T way; a product of matrices is slower
        ahead = seen[..., 2] > MIN_DEPTH
        safe = torch.where(ahead[..., None], seen, seen.new_tensor([0.0, 0.0, 1.0]))
        camera = self.capture.camera
        xy = camera.project(safe)
        inside = ahead & ((xy >= 0) & (xy < xy.new_tensor(camera.size))).all(-1)
        visible = inside.float()
        if self.depth is not None:
            visible = visible * self._unoccluded(safe, frames, source, inside)
        if self.options.quality_power:
            visible = visible * self.quality[frames][source] ** self.options.quality_power
        unit = torch.nn.functional.normalize(direction, dim=-1)[:, None]
        change = torch.nn.functional.normalize(way, dim=-1) - unit
        return Projection(source, xy, change, visible)

    def _unoccluded(
        self,
        seen: Float[Tensor, "n v 3"],
        frames: Int64[Tensor, "u"],
        source: Int64[Tensor, "n v"],
        inside: Bool[Tensor, "n v"],
    ) -> Float[Tensor, "n v"]:
        """One where a sample is not behind the measured depth, falling to zero behind it."""
        assert self.depth is not None
        maps = np.stack([self.depth.at(i) for i in frames.tolist()])
        measured = torch.from_numpy(maps).to(seen.device)
        size = seen.new_tensor(self.depth.camera.size)
        xy = self.depth.camera.project(seen)
        within = inside & ((xy >= 0) & (xy < size)).all(-1)
        x, y = torch.where(within[..., None], xy, 0).long().unbind(-1)
        there = measured[source, y, x]
        slack = self.options.depth_tolerance * self.radius
        behind = (seen[..., 2] - there - slack).clamp_min(0) / slack
        return torch.where(within & (there > 0), torch.exp(-behind), 1.0)


def nearest_in_order(
    frames: int, train: Int64[np.ndarray, "a"], count: int
) -> Int64[np.ndarray, "n v"]:
    """The training frames nearest in order to every frame, without itself; earlier ones first.

    Args:
        frames: Number of frames.
        train: Training frames.
        count: Number wanted; fewer if there are not so many.
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
    """Rays that are rendered without images."""


class ImageBranch(nn.Module):
    """Source images, the networks that read them, and the network that fuses them with points.

    Args:
        options: Selection and interpolation of source images.
        capture: With frames.
        feature: Width of the feature of a sample.
        seed: Random seed of the run.
        radius: Radius of the neighbours of a sample, in world units.
        quality: Quality of every frame; one on average.
        width: Width of the network that weights sources.
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
        """Select the sources of rays and extract their features.

        Args:
            rays: On one leading axis.
            frame: Frame of each ray, or the one nearest in time.
            alone: Rays that are rendered without images.
            learning: Leave out the frame of the ray itself.
        """
        chosen = self.sources.of_rays(frame, rays.origin, rays.direction, exclude=learning)
        frames, source = torch.unique(chosen, return_inverse=True)
        levels = self.extractor(self.sources.frame_images(frames))
        return Prepared(frames, source, levels, alone)

    def forward(
        self, feature: Float[Tensor, "n r"], asked: ShadedSamples, ready: Prepared
    ) -> tuple[Float[Tensor, "n r"], Float[Tensor, "n c"], Float[Tensor, "n 1"]]:
        """Fuse the features of points with those of the source images.

        Args:
            feature: Features of the samples, from points.
            asked: The samples.
            ready: Source images of their rays.

        Returns:
            Mixed features; sum of the sources' colours by weight; sum of these weights.
        """
        source = ready.source[asked.ray]
        projection = self.sources.project(asked.place, asked.direction, ready.frames, source)
        xy = (
            projection.xy.floor() + 0.5
            if self.options.interpolation == "nearest"
            else projection.xy
        )
        looked = sample_pyramid(xy.flatten(0, 1), source.flatten(), ready.levels)
        looked = looked.view(*source.shape, looked.shape[-1])
        with_images = ~ready.alone[asked.ray][:, None]
        merged, weight = self.merging(looked, feature, projection.change, projection.visible)
        weight = weight * with_images
        mixed = self.mixing(feature, merged * with_images)
        light = (weight[..., None] * looked[..., : self.colours]).sum(1)
        return mixed, light, weight.sum(-1, keepdim=True)
