"""A dynamic scene on voxels: a centred capture, static and moving voxel grids, a renderer.

Regularisers settle what events leave open: moving voxels are smooth in space and in time, and empty
space is transparent.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.events.index import EventIndex
from sharpfield.fields.voxels import VoxelField, VoxelSizes, moving_shapes, static_shapes
from sharpfield.geometry.normalise import recentred
from sharpfield.initialisation.visual_hull import visual_hull
from sharpfield.ops.voxel_march import DENSITY_SHIFT
from sharpfield.rendering.voxels import BoxSteps

PENALTY_POINTS = 2048
"""Random points of the density penalty in each step."""

DENSE = 10.0
"""Steepness of the logarithm: a tenth of an e-fold in a step is dense."""


@dataclass(frozen=True)
class MovingOptions:
    """The voxel grids, and their samples on rays."""

    size: VoxelSizes = field(default_factory=VoxelSizes)
    samples: int = 64
    """Samples of a ray from side to side of the box."""
    static_density: float = -3.0
    """First raw density of the static grid: nearly empty, as events do not show static parts."""
    hull: bool = True
    """Use the visual hull: voxels move only where and when every static camera sees motion."""
    moving_density: float = 6.0
    """First raw density of the moving grid inside the hull: nearly opaque."""
    density_weight: float = 3.0
    """Weight of the density penalty at random points of the box."""
    tv_weight: float = 0.1
    """Weight of the total variation in space of the moving grid."""
    time_tv_weight: float = 1e-3
    """Weight of the total variation in time of the moving grid."""


class MovingScene(nn.Module):
    """A dynamic scene and its capture, in a box around the point that the cameras look at.

    Args:
        options: Sizes and sampling.
        capture: As read.
        seed: Random seed of the run.
        index: Index of the capture's events, for the visual hull.
    """

    def __init__(
        self, options: MovingOptions, capture: Capture, seed: int, index: EventIndex | None = None
    ) -> None:
        super().__init__()
        self.options, self.seed = options, seed
        self.capture, self.change = recentred(capture)
        self.path = self.capture.trajectory
        hulls, shapes = None, moving_shapes(options.size)
        if options.hull and index is not None:
            hulls = [visual_hull(self.capture, index, cells, moments) for moments, cells in shapes]
        occupied = [one.possible for one in hulls or [] if one is not None]
        self.field = VoxelField(
            static_shapes(options.size),
            occupied or [torch.ones(moments, n, n, n).bool() for moments, n in shapes],
            raw_density=options.static_density,
            background=True,
        )
        if hulls and hulls[0] is not None:
            self.field.fill(hulls[0].solid, options.moving_density)
        self.view = BoxSteps(self.field, step=2 / options.samples)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.field.static[0].device

    def sharp(self, rays: Rays, step: int, stream: str) -> Radiance:
        """Training radiance along rays: jittered samples, by seed, step and stream."""
        return self.view(rays, generator(self.seed, step, stream, self.device))

    def total_variation(self, step: int) -> Tensor:
        """Total variation of the moving grid in space and in time, at one random moment."""
        random = generator(self.seed, step, "moment")
        last = len(self.field.rows[0]) - 1
        moment = int(torch.randint(last, (), generator=random))
        part, held = self.field.moments(moment, 2)

        def changed(axis: int) -> Tensor:
            ends = [held.narrow(axis, k, held.shape[axis] - 1) for k in (0, 1)]
            both = (ends[0] & ends[1])[..., None]
            return (part.diff(dim=axis).square() * both).sum() / both.sum().clamp_min(1) / 4

        across = torch.stack([changed(axis) for axis in (1, 2, 3)]).sum()
        return self.options.tv_weight * across + self.options.time_tv_weight * changed(0)

    def density_penalty(self, step: int) -> Tensor:
        """Density penalty at random points of the box, at one random moment.

        The logarithm leaves surfaces free to be dense (Plenoxels, CVPR 2022).
        """
        random = generator(self.seed, step, "fog")
        points = 2 * torch.rand(PENALTY_POINTS, 3, generator=random) - 1
        time = float(torch.rand((), generator=random))
        raw = self.field.raw_density(points.to(self.device), time)
        return (
            self.options.density_weight
            * torch.log1p(DENSE * functional.softplus(raw + DENSITY_SHIFT)).mean()
        )

    def groups(self, rate: Schedule) -> list[Group]:
        """Parameters of voxels and background with their learning rate."""
        return [Group("voxels", tuple(self.field.parameters()), rate)]
