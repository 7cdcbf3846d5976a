"""The sharp scene of the recipes on neural points: a cloud from depth, its networks, and rays."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.fields.points.cloud import NeuralPoints
from sharpfield.fields.points.networks import PointField, PointSizes
from sharpfield.initialisation.point_cloud import CloudOptions, starting_cloud
from sharpfield.rendering.points import Colour, PointMarch, PointRadiance

VOXEL_OF_SPACING = 0.8
"""Edge of a voxel over the distance between points: 8 mm for the points of a ninehundredth."""

CELL, RADIUS = 2, 4
"""Edge of the cells in which neighbours are looked up, and how far neighbours are, in voxels."""

STEP = 2.5
"""Length of steps, in voxels, where their number is left open."""

BEYOND = 1.25
"""Rays at the corners of an image are longer than the depth there by about so much."""


@dataclass(frozen=True)
class MarchOptions:
    """Samples on rays through points. Defaults: Hybrid Neural Rendering's for ScanNet."""

    voxel: float = 0.008
    """Edge of a voxel in world units; 0 takes 0.8 times the distance between points. Neighbours are
    up to 4 voxels away."""
    steps: int = 400
    """Steps between near and far; 0 takes steps of 2.5 voxels."""
    max_samples: int = 24
    """Maximum number of samples on a ray whose neighbours are looked up."""
    thickness: float = 0.0
    """Length in world units over which the density of a sample absorbs light; 0 takes a voxel."""
    background: float = 1.0
    """Stored value of the background: 0 black to 1 white."""


class PointScene(nn.Module):
    """Neural points that explain a capture, in the capture's own world.

    Args:
        cloud: The first points.
        sizes: Sizes of the networks; a `unit` of 0 becomes the radius of neighbours.
        march: Samples on rays.
        capture: As read.
        seed: Random seed of the run.
        weight: Weight of each frame in the first colours.
    """

    poses: Tensor
    times: Tensor

    def __init__(
        self,
        cloud: CloudOptions,
        sizes: PointSizes,
        march: MarchOptions,
        capture: Capture,
        seed: int,
        *,
        weight: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        super().__init__()
        self.capture, self.seed = capture, seed
        start = starting_cloud(cloud, capture, seed, weight=weight)
        voxel = march.voxel or VOXEL_OF_SPACING * start.spacing
        points = NeuralPoints.start(
            torch.from_numpy(start.positions),
            torch.from_numpy(start.colours),
            torch.from_numpy(start.directions),
            channels=sizes.channels,
            cell=CELL * voxel,
            generator=generator(seed, 0, "descriptors"),
        )
        radius = RADIUS * voxel
        self.field = PointField(
            replace(sizes, unit=sizes.unit or radius), points, radius=radius, seed=seed
        )
        turned = sizes.axes == "camera"
        far = capture.far * (1 if turned else BEYOND)
        self.march = PointMarch(
            self.field,
            near=capture.near,
            far=far,
            steps=march.steps or max(round((far - capture.near) / (STEP * voxel)), 1),
            asked=march.max_samples,
            thickness=march.thickness or voxel,
            background=march.background,
        )
        every = np.arange(len(capture.needed_frames))
        self.register_buffer("poses", capture.frame_pose(every).detach().float(), persistent=False)
        self.register_buffer("times", capture.frame_time.mean(-1), persistent=False)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.poses.device

    def meet(
        self,
        rays: Rays,
        colour: Colour,
        *,
        frame: Int64[Tensor, "b"] | None = None,
        step: int | None = None,
    ) -> PointRadiance:
        """Render rays.

        Args:
            rays: On one leading axis.
            colour: Colour of the samples that send light.
            frame: Frame of each ray; by default the frame nearest in time.
            step: Training step, whose samples are jittered; None for evaluation.
        """
        turn = None
        if self.field.sizes.axes == "camera":
            frame = self.frame_at(rays.time) if frame is None else frame
            turn = self.poses[frame, :, :3].mT
        made = None if step is None else generator(self.seed, step, "steps", self.device)
        return self.march(rays, colour, turn=turn, generator=made)

    def frame_at(self, time: Float[Tensor, "b"]) -> Int64[Tensor, "b"]:
        """The frame nearest in time, of all that the capture has."""
        ordered, order = self.times.sort()
        after = torch.searchsorted(ordered, time.contiguous()).clamp(1, max(len(ordered) - 1, 1))
        if len(ordered) == 1:
            return torch.zeros_like(after)
        before = after - 1
        later = (ordered[after] - time) < (time - ordered[before])
        return order[torch.where(later, after, before)]

    def groups(self, networks: Schedule, points: Schedule) -> list[Group]:
        """Parameters of the networks and of the points."""
        own = tuple(self.field.points.parameters())
        known = {id(parameter) for parameter in own}
        rest = tuple(p for p in self.field.parameters() if id(p) not in known)
        return [Group("networks", rest, networks), Group("points", own, points)]
