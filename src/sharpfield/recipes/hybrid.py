"""Hybrid neural rendering: rooms from blurry video, by neural points and the images around.

P. Dai et al., *Hybrid Neural Rendering for Large-Scale Scenes with Motion Blur*, CVPR 2023. Points
say what is where, the frames nearby what it looks like. Rendered patches are blurred like recorded
ones before they are compared, and sharp frames count more.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.paper import Paper
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
from sharpfield.recipes.points.model import DrawOptions, PointModel
from sharpfield.recipes.points.scene import PointScene
from sharpfield.recipes.settings.presets import Presets

PAPER = Paper(
    key="dai2023hybrid",
    title="Hybrid Neural Rendering for Large-Scale Scenes with Motion Blur",
    bibtex="""@inproceedings{dai2023hybrid,
  title     = {Hybrid Neural Rendering for Large-Scale Scenes with Motion Blur},
  author    = {Dai, Peng and Zhang, Yinda and Yu, Xin and Lyu, Xiaoyang and Qi, Xiaojuan},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2023}
}""",
    departures=(
        "Neighbours are the nearest in the window of cells; the released code stops at the first"
        " layer of cells that holds enough, drops points by chance where a cell is full, and gives"
        " its first occupied cell no points.",
        "Descriptors start by chance, and networks by Xavier's rule; the released code starts them"
        " from weights trained on another data set for a day. Such a checkpoint can be loaded"
        " (`released`).",
        "Depth of held-out frames is not used unless cloud.frames is `all`, as published.",
        "The regulariser of confidence leaves out empty slots, which the released code fills with"
        " the first point.",
        "Rows of points that a step does not touch are left alone; the released code moves all by"
        " the momentum of Adam. Nothing restarts when points grow.",
        "Maps of features are read at their own size, which gives the same numbers as enlarging"
        " them first.",
        "Images do not tell about places behind their camera or a little outside their edge.",
        "Rays that miss are left out of a patch before it is blurred; the released code blurs the"
        " background into their neighbours.",
        "Which patches do without images is drawn anew each step; the released code always takes"
        " the same slots, whose places in the image are by chance.",
        "New points in one round of growth all get the same share of their neighbours' confidence;"
        " in the released code those of earlier frames get powers of it.",
        "Points from depth are voxel means at pixel centres; the released code takes the point"
        " nearest the mean, and is off by half a pixel.",
        "In evaluation, the camera's axes are those of the frame nearest in time, and colour is"
        " left out where a sample sends less than 1e-4 of a ray's light.",
    ),
)


@dataclass(frozen=True)
class BlurOptions:
    """How rendered patches are made as blurry as recorded ones. Defaults: Full's for ScanNet."""

    kind: Literal["none", "chosen", "learned"] = "chosen"
    """Not at all (H), by the best of fixed kernels (Full), or by a network."""
    size: int = 9
    """Of kernels, in pixels of a patch; odd."""
    distances: tuple[int, ...] = (1, 2, 4)
    """How far fixed strokes reach."""
    strokes: Kind = "both"
    """Which there are: 36 for ScanNet; the paper's rooms have the 12 that go through the pixel."""
    edge: Edge = "keep"
    """What a learned kernel does at the edge of a patch."""
    still_share: Literal["learned", "none"] = "learned"
    """Whether the network also says how much of a pixel stays where it is."""
    light: Literal["stored", "linear"] = "stored"
    """What is added up: stored values, as published, or light."""


def h_only(recipe: "Hybrid") -> "Hybrid":
    """H of the paper: single pixels, no blur, all frames alike."""
    drawn = replace(recipe.drawn, patches=3136, side=1)
    return replace(recipe, drawn=drawn, blur=replace(recipe.blur, kind="none"), quality="even")


def rooms(recipe: "Hybrid") -> "Hybrid":
    """Full as the paper has it for simulated rooms: 12 kernels, patches up to 6 pixels apart."""
    blur = replace(recipe.blur, strokes="through")
    return replace(recipe, blur=blur, drawn=replace(recipe.drawn, apart=(1, 6)))


def learned(recipe: "Hybrid") -> "Hybrid":
    """Full with a kernel learned for each patch."""
    return replace(recipe, blur=replace(recipe.blur, kind="learned"))


def no_images(recipe: "Hybrid") -> "Hybrid":
    """The control of the paper: points alone."""
    return replace(recipe, sources=replace(recipe.sources, count=0))


def draft(recipe: "Hybrid") -> "Hybrid":
    """Minutes on two CPU cores; sources by pose, what hides them by depth, light adds up."""
    return replace(_by_pose_and_depth(point_nerf.draft(recipe)), merge=32)


def standard(recipe: "Hybrid") -> "Hybrid":
    """Minutes on a GPU, hours on a CPU."""
    return _by_pose_and_depth(point_nerf.standard(recipe))


def _by_pose_and_depth(recipe: "Hybrid") -> "Hybrid":
    """Images chosen and seen through by what poses and depth tell."""
    sources = replace(
        recipe.sources,
        choose="pose",
        fetch="bilinear",
        visibility="depth",
        trust=1.0,
        prefer=1.0,
    )
    judged = recipe.quality if recipe.quality == "even" else "auto"
    return replace(
        recipe, sources=sources, quality=judged, blur=replace(recipe.blur, light="linear")
    )


@dataclass(frozen=True)
class Hybrid(PointNeRF):
    """Neural points and features of nearby images to a scene, from blurry video with depth."""

    paper: ClassVar[Paper] = PAPER
    presets: ClassVar[Presets] = Presets(
        variants={"h-only": h_only, "rooms": rooms, "learned": learned, "no-images": no_images},
        sizes={"draft": draft, "standard": standard, "paper": point_nerf.published},
        renamed={"no-pictures": "no-images"},
    )

    drawn: DrawOptions = field(default_factory=lambda: DrawOptions(patches=49, side=8))
    sources: SourceOptions = field(default_factory=SourceOptions)
    blur: BlurOptions = field(default_factory=BlurOptions)
    quality: Literal["even"] | Judge = "published"
    """How much each frame counts: all alike; as published; by events where there are any; by how
    sharp frames look; by events."""
    merge: int = 64
    """Width of the network that weighs images."""
    released: str = ""
    """A checkpoint of the released code to start from: its `*_net_ray_marching.pth`."""

    def build(self, capture: Capture, seed: int) -> PointModel:
        """The recipe on one capture.

        Raises:
            OptionError: Blur is modelled on single pixels.
        """
        if self.blur.kind != "none" and self.drawn.side < 2:
            raise OptionError(
                "blur is modelled on patches, and single pixels are drawn",
                got=f"blur.kind {self.blur.kind}, drawn.side {self.drawn.side}",
                do="set drawn.side to 8, or blur.kind to none",
            )
        weight = quality_of(capture, self.quality)
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
                width=self.merge,
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
        if self.released:
            load_released(Path(self.released), scene.field, model.head, images, model.blur)
        return model

    def _blur(self, seed: int) -> ChosenKernel | LearnedKernel | None:
        blur = self.blur
        if blur.kind == "none":
            return None
        if blur.kind == "chosen":
            return ChosenKernel(motion_kernels(blur.size, blur.distances, kind=blur.strokes))
        return LearnedKernel(
            self.drawn.side,
            seed=seed,
            size=blur.size,
            edge=blur.edge,
            still_share=blur.still_share,
        )


def quality_of(capture: Capture, kind: Literal["even"] | Judge) -> Float[np.ndarray, "n"]:
    """How much each frame counts, one on average; frames that are held out count one."""
    if kind == "even":
        return np.ones(len(capture.needed_frames))
    weight = frame_weights(capture, kind)
    learned = capture.split.train
    weight[learned] = weight[learned] / weight[learned].mean()
    return weight
