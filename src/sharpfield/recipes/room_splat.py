"""Rooms on Gaussians: sharp large scenes from a walk with a blurry camera, in minutes.

The ideas of P. Dai et al., *Hybrid Neural Rendering for Large-Scale Scenes with Motion Blur*,
CVPR 2023, on another engine: the scene starts on what a depth camera measured, or on a point
cloud; frames that are sharp teach more than blurred ones; and blur is simulated while training.
Here it is the mean of views along the motion of the camera inside each exposure, known or learned.
Where the capture has events, these say which frames are blurred, and make them sharp.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

from sharpfield.core.paper import Paper
from sharpfield.recipes.hybrid import PAPER
from sharpfield.recipes.looks import LookOptions
from sharpfield.recipes.splat_scene import GaussianOptions
from sharpfield.recipes.splats import Splat

DAI = replace(
    PAPER,
    departures=(
        "Gaussians instead of neural points and image features.",
        "Blur is the mean of views along the camera's motion, instead of a kernel for each patch.",
        "Frames are drawn as often as their quality says, instead of weighing their loss.",
        "What the depth camera measured is a loss, too.",
    ),
)


@dataclass(frozen=True)
class RoomSplat(Splat):
    """Gaussians from a walk through a room: depth, quality weights, and blur along the motion."""

    paper: ClassVar[Paper] = DAI

    gaussians: GaussianOptions = field(default_factory=lambda: GaussianOptions(density=1.5))
    looks: LookOptions = field(
        default_factory=lambda: LookOptions(still=0.5, quality="auto", depth=0.1)
    )
