"""Dynamic scenes of the volume recipes: deformed, or on voxels that change with time.

The deformed one is that of D-NeRF, a canonical radiance field and a deformation field: A. Pumarola
et al., *D-NeRF: Neural Radiance Fields for Dynamic Scenes*, CVPR 2021, as EvDNeRF (WACV 2024) uses
it. On voxels, regularisers settle what events leave open: moving voxels are smooth in space and in
time, and empty space is transparent.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.events.index import EventIndex
from sharpfield.fields.mlp import MLPField
from sharpfield.fields.voxels import VoxelField, VoxelSizes, moving_shapes, static_shapes
from sharpfield.fields.warp import AtZero, Deformation, Warped
from sharpfield.geometry.normalise import recentred
from sharpfield.geometry.space import EvenDepth
from sharpfield.initialisation.visual_hull import carve_visual_hull
from sharpfield.ops.voxel_march import DENSITY_SHIFT
from sharpfield.recipes.volume.scene import soft
from sharpfield.rendering.coarse_to_fine import CoarseToFine, Compositing
from sharpfield.rendering.voxels import BoxSteps

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "sigmoid": torch.sigmoid,
    "relu": torch.relu,
    "softplus": soft,
}


@dataclass(frozen=True)
class WarpedOptions:
    """The networks, and their samples on rays. Defaults: the released code of EvDNeRF."""

    width: int = 256
    """Width of all layers."""
    depth: int = 8
    """Number of layers of each network."""
    networks: int = 1
    """Canonical networks: 1 for both stages, or 2, a coarse and a fine one."""
    colours: int = 1
    """Channels: 1 for grey, 3 for colour."""
    samples: tuple[int, int] = (64, 128)
    """Coarse samples on a ray, and fine samples added to them."""
    density: Literal["sigmoid", "relu", "softplus"] = "sigmoid"
    """Activation of the density per unit of length. The released sigmoid never exceeds 1, so
    that a wall half a unit thick lets 61 % through."""
    opaque_end: bool = True
    """Whether the last sample of a ray is opaque (released); else the background is black."""
    at_zero: AtZero = "exactly"
    """How the deformation vanishes at time 0, where the scene is the canonical one."""
    shared_jitter: bool = False
    """Whether both instants of a window have the same jitter; released: independent jitter, so that
    even static parts change."""


class WarpedScene(nn.Module):
    """A dynamic scene in the world and units of the capture.

    Args:
        options: Sizes and sampling.
        capture: As read.
        seed: Random seed of the run.
    """

    def __init__(self, options: WarpedOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.capture, self.seed = options, capture, seed
        self.path = capture.trajectory
        made = generator(seed, 0, "field")
        canonical = MLPField(
            generator=made,
            width=options.width,
            depth=options.depth,
            colours=options.colours,
            networks=options.networks,
        )
        deformation = Deformation(
            generator=made, width=options.width, depth=options.depth, at_zero=options.at_zero
        )
        self.field = Warped(canonical, deformation)
        how = Compositing(ACTIVATIONS[options.density], opaque_end=options.opaque_end)
        space = EvenDepth(capture.camera, capture.near, capture.far)
        self.view = CoarseToFine(self.field, space, options.samples, 0.0, how)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    def sharp(self, rays: Rays, step: int, stream: str) -> Radiance:
        """Training radiance along rays `[b, k]`: jittered samples, by seed, step and stream."""
        made = generator(self.seed, step, stream, self.device)
        if not self.options.shared_jitter:
            return self.view(rays, made)
        start = made.get_state()
        parts = []
        for k in range(rays.shape[1]):
            made.set_state(start)
            parts.append(self.view(rays[:, k : k + 1], made))
        return Radiance.cat(parts, axis=1)  # [b, k]

    def groups(self, rate: Schedule) -> list[Group]:
        """Parameters of all networks with their learning rate."""
        return [Group("networks", tuple(self.parameters()), rate)]


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
            hulls = [
                carve_visual_hull(self.capture, index, cells, moments) for moments, cells in shapes
            ]
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
