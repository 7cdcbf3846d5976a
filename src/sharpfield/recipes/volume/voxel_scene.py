"""A moving scene of the recipes without networks: a capture around its middle, a field, a renderer.

Its terms ask for what events leave open: what moves is smooth, in space and in time.
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

FOG_POINTS = 2048
"""Points that are asked for fog in each step."""

DENSE = 10.0
"""Steepness of the logarithm: a tenth of an e-fold in a step is dense."""


@dataclass(frozen=True)
class MovingOptions:
    """The field, and how rays sample it."""

    size: VoxelSizes = field(default_factory=VoxelSizes)
    steps: int = 64
    """Of a ray from side to side of the box."""
    clear: float = -3.0
    """First raw density of what stands still: nearly empty, as events do not say what is there."""
    hull: bool = True
    """Voxels move only where and when every camera that stands still sees something move."""
    solid: float = 6.0
    """First raw density of what moves, where they do: nearly opaque."""
    empty: float = 3.0
    """Weight of how dense the box is: what nothing speaks for stays empty."""
    smooth: float = 0.1
    """Weight of the total variation in space of what moves."""
    steady: float = 1e-3
    """Weight of its change from moment to moment."""


class MovingScene(nn.Module):
    """A sharp moving scene and the capture it explains, in a box around what the cameras look at.

    Args:
        options: Sizes and sampling.
        capture: As read.
        seed: Of the run.
        index: Of the capture's events, if they may say where something moves.
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
            raw_density=options.clear,
            background=True,
        )
        if hulls and hulls[0] is not None:
            self.field.fill(hulls[0].solid, options.solid)
        self.view = BoxSteps(self.field, step=2 / options.steps)

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.field.static[0].device

    def sharp(self, rays: Rays, step: int, stream: str) -> Radiance:
        """Light along rays while training: jittered by seed, step and stream."""
        return self.view(rays, generator(self.seed, step, stream, self.device))

    def roughness(self, step: int) -> Tensor:
        """How rough what moves is in space, and how much it changes, at one random moment."""
        random = generator(self.seed, step, "moment")
        last = len(self.field.rows[0]) - 1
        moment = int(torch.randint(last, (), generator=random))
        part, held = self.field.moments(moment, 2)

        def changed(axis: int) -> Tensor:
            ends = [held.narrow(axis, k, held.shape[axis] - 1) for k in (0, 1)]
            both = (ends[0] & ends[1])[..., None]
            return (part.diff(dim=axis).square() * both).sum() / both.sum().clamp_min(1) / 4

        across = torch.stack([changed(axis) for axis in (1, 2, 3)]).sum()
        return self.options.smooth * across + self.options.steady * changed(0)

    def fog(self, step: int) -> Tensor:
        """How dense the box is at random points, at one random moment.

        The logarithm lets surfaces be as dense as they like (Plenoxels, CVPR 2022).
        """
        random = generator(self.seed, step, "fog")
        points = 2 * torch.rand(FOG_POINTS, 3, generator=random) - 1
        time = float(torch.rand((), generator=random))
        raw = self.field.raw_density(points.to(self.device), time)
        return (
            self.options.empty
            * torch.log1p(DENSE * functional.softplus(raw + DENSITY_SHIFT)).mean()
        )

    def groups(self, rate: Schedule) -> list[Group]:
        """Voxels and background."""
        return [Group("voxels", tuple(self.field.parameters()), rate)]
