"""Hybrid Neural Rendering: rooms from blurry video, by neural points and image-based rendering.

P. Dai et al., *Hybrid Neural Rendering for Large-Scale Scenes with Motion Blur*, CVPR 2023. Points
carry geometry, features of nearby frames carry appearance. Rendered patches are blurred before they
are compared with recorded ones, and the loss of a frame is weighted by its quality.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.protocols import Paper
from sharpfield.formation.patch_kernel import (
    ChosenKernel,
    Edge,
    Kind,
    LearnedKernel,
    motion_kernels,
)
from sharpfield.metrics.quality import Judge, frame_weights
from sharpfield.recipes import point_nerf
from sharpfield.recipes.point_nerf import PointNeRF
from sharpfield.recipes.points.hybrid_checkpoint import load_released
from sharpfield.recipes.points.images import ImageBranch, SourceOptions
from sharpfield.recipes.points.model import PatchSamplingOptions, PointModel
from sharpfield.recipes.points.scene import PointScene
from sharpfield.recipes.settings.presets import Presets, paper_of, published


@dataclass(frozen=True)
class BlurOptions:
    """Blur of rendered patches. Defaults: the numbers of `Full` for ScanNet."""

    kind: Literal["none", "chosen", "learned"] = "chosen"
    """`none` (H); `chosen`, the best of fixed kernels for each patch (Full); or a network."""
    size: int = 9
    """Side of the kernels in pixels of a patch; odd."""
    distances: tuple[int, ...] = (1, 2, 4)
    """Lengths of the fixed motion kernels from the centre, in pixels of a patch."""
    strokes: Kind = "both"
    """Fixed kernels: `both` are the 36 for ScanNet; `through` are the 12 through the pixel that the
    paper uses for its simulated rooms."""
    edge: Edge = "keep"
    """Padding of a learned kernel at the edge of a patch."""
    still_share: Literal["learned", "none"] = "learned"
    """Whether the kernel network also predicts the weight of the unblurred pixel."""
    light: Literal["stored", "linear"] = "stored"
    """What is averaged: stored values, as published, or linear light."""


def h_only(recipe: "Hybrid") -> "Hybrid":
    """H of the paper: single pixels, no blur, equal weights of all frames."""
    sampling = replace(recipe.sampling, patches=3136, patch_size=1)
    return replace(
        recipe, sampling=sampling, blur=replace(recipe.blur, kind="none"), frame_quality="even"
    )


def rooms(recipe: "Hybrid") -> "Hybrid":
    """Full of the paper for simulated rooms: 12 kernels, pixels of a patch up to 6 apart."""
    blur = replace(recipe.blur, strokes="through")
    return replace(recipe, blur=blur, sampling=replace(recipe.sampling, spacing=(1, 6)))


def learned(recipe: "Hybrid") -> "Hybrid":
    """Full with a kernel network instead of fixed kernels."""
    return replace(recipe, blur=replace(recipe.blur, kind="learned"))


def no_images(recipe: "Hybrid") -> "Hybrid":
    """The ablation of the paper without images: points alone."""
    return replace(recipe, sources=replace(recipe.sources, count=0))


def draft(recipe: "Hybrid") -> "Hybrid":
    """Minutes on two CPU cores; sources by pose, visibility by depth, blur in linear light."""
    return replace(_by_pose_and_depth(point_nerf.draft(recipe)), merge_width=32)


def standard(recipe: "Hybrid") -> "Hybrid":
    """Minutes on a GPU, hours on a CPU."""
    return _by_pose_and_depth(point_nerf.standard(recipe))


def _by_pose_and_depth(recipe: "Hybrid") -> "Hybrid":
    """Source images selected by pose, visibility by measured depth."""
    sources = replace(
        recipe.sources,
        selection="pose",
        interpolation="bilinear",
        visibility="depth",
        quality_power=1.0,
        selection_quality_power=1.0,
    )
    judged = recipe.frame_quality if recipe.frame_quality == "even" else "auto"
    return replace(
        recipe, sources=sources, frame_quality=judged, blur=replace(recipe.blur, light="linear")
    )


@dataclass(frozen=True)
class Hybrid(PointNeRF):
    """Neural points with features of nearby images, from blurry video with depth."""

    paper: ClassVar[Paper] = paper_of("hybrid")
    renamed: ClassVar[dict[str, str]] = {
        **PointNeRF.renamed,
        "sources.choose": "sources.selection",
        "sources.fetch": "sources.interpolation",
        "sources.slack": "sources.depth_tolerance",
        "sources.drop": "sources.dropout",
        "sources.trust": "sources.quality_power",
        "sources.prefer": "sources.selection_quality_power",
        "quality": "frame_quality",
        "merge": "merge_width",
        "released": "checkpoint",
    }
    presets: ClassVar[Presets] = Presets(
        variants={"h-only": h_only, "rooms": rooms, "learned": learned, "no-images": no_images},
        sizes={"draft": draft, "standard": standard, "paper": published},
        renamed={"no-pictures": "no-images"},
    )

    sampling: PatchSamplingOptions = field(
        default_factory=lambda: PatchSamplingOptions(patches=49, patch_size=8)
    )
    sources: SourceOptions = field(default_factory=SourceOptions)
    blur: BlurOptions = field(default_factory=BlurOptions)
    frame_quality: Literal["even"] | Judge = "published"
    """Weight of the loss of each frame: `even`; `published`, the paper's score; `auto`, by events
    where there are any; `images`, by sharpness; `events`."""
    merge_width: int = 64
    """Width of the network that weights source images."""
    checkpoint: str = ""
    """Path of a checkpoint of the released code to start from: its `*_net_ray_marching.pth`."""

    def build(self, capture: Capture, seed: int) -> PointModel:
        """The recipe on one capture.

        Raises:
            OptionError: Blur is asked for, and patches are single pixels.
        """
        if self.blur.kind != "none" and self.sampling.patch_size < 2:
            raise OptionError(
                "blur needs patches, and single pixels are sampled",
                got=f"blur.kind {self.blur.kind}, sampling.patch_size {self.sampling.patch_size}",
                do="set sampling.patch_size to 8, or blur.kind to none",
            )
        weight = quality_weights(capture, self.frame_quality)
        scene = PointScene(self.cloud, self.sizes, self.march, capture, seed, weight=weight)
        images = None
        if self.sources.count > 0:
            images = ImageBranch(
                self.sources,
                capture,
                self.sizes.feature,
                seed,
                radius=scene.field.radius,
                quality=weight,
                width=self.merge_width,
            )
        model = PointModel(
            self,
            capture,
            seed,
            scene,
            images=images,
            blur=self._blur(seed),
            light=self.blur.light,
            weight=weight,
        )
        if self.checkpoint:
            load_released(Path(self.checkpoint), scene.field, model.head, images, model.blur)
        return model

    def _blur(self, seed: int) -> ChosenKernel | LearnedKernel | None:
        blur = self.blur
        if blur.kind == "none":
            return None
        if blur.kind == "chosen":
            return ChosenKernel(motion_kernels(blur.size, blur.distances, kind=blur.strokes))
        return LearnedKernel(
            self.sampling.patch_size,
            seed=seed,
            size=blur.size,
            edge=blur.edge,
            still_share=blur.still_share,
        )


def quality_weights(capture: Capture, kind: Literal["even"] | Judge) -> Float[np.ndarray, "n"]:
    """Weight of the loss of each frame, one on average; held-out frames have one."""
    if kind == "even":
        return np.ones(len(capture.needed_frames))
    weight = frame_weights(capture, kind)
    learned = capture.split.train
    weight[learned] = weight[learned] / weight[learned].mean()
    return weight
