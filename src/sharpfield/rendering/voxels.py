"""Volume rendering of a voxel field in even steps: between two depths, or through a box."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from sharpfield.core.rays import Radiance, Rays
from sharpfield.geometry.space import Frustum, Space
from sharpfield.ops import stepfun
from sharpfield.ops.voxel_march import march_voxels


@runtime_checkable
class Voxels(Protocol):
    """Raw density and colour in a box, see `ops.voxel_march`."""

    static: nn.ParameterList
    """Static grids."""
    moving: nn.ParameterList
    """Values of the cells of moving grids that have any."""

    @property
    def rows(self) -> Sequence[Tensor]:
        """Rows of these cells."""
        ...

    def in_box(
        self, origin: Float[Tensor, "b 3"], direction: Float[Tensor, "b 3"]
    ) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]]:
        """Rays in box coordinates."""
        ...

    def background(self) -> Float[Tensor, "3"] | None:
        """Light from behind the box; None for black."""
        ...


@dataclass(frozen=True)
class EvenSteps:
    """Volume rendering between the near and far depth of a space; every sample is one step.

    Samples are jittered within their steps when a generator is given, as in training.
    """

    field: Voxels
    space: Space
    samples: int = 96
    clear_before: float = 0.0
    """In evaluation, samples up to this ray parameter (0...1) are left out."""

    def __call__(
        self, rays: Rays, generator: Generator | None = None, *, samples: bool = False
    ) -> Radiance:
        """Radiance of rays of any shape; `samples` has no effect: there are no features."""
        flat = rays.reshape(-1)
        depths = self._depths(flat, generator)
        opaque_end = isinstance(self.space, Frustum)
        seen = _march(self.field, self.space.warp(flat), flat, depths, opaque_end=opaque_end)
        return seen.reshape(*rays.shape)

    def _depths(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "b s"]:
        near, far = self.space.near, self.space.far
        if generator is None:
            steps = stepfun.even_positions(rays.shape, 2 * self.samples + 1, rays.device)
            steps = steps[:, 1::2]  # middles of the steps
            steps = steps[:, near + (far - near) * steps[0] > self.clear_before]
        else:
            steps = stepfun.stratified_positions(rays.shape, self.samples, generator)
        return near + (far - near) * steps


@dataclass(frozen=True)
class BoxSteps:
    """Volume rendering of the box from -1 to 1 in steps of equal length.

    When a generator is given, as in training, the samples of a ray are shifted by a random fraction
    of a step. All rays of one measurement get the same shift, so that their difference shows only
    what changes between them.
    """

    field: Voxels
    step: float = 2 / 48
    """Length of a step, in units of the box."""

    def __call__(self, rays: Rays, generator: Generator | None = None) -> Radiance:
        """Radiance of rays `[*b, k]`; their depth is 0 where they miss the box."""
        shift = torch.full((*rays.shape[:-1], 1), 0.5, device=rays.device)
        if generator is not None:
            shift = torch.rand(shift.shape, generator=generator, device=rays.device)
        flat = rays.reshape(-1)
        enter, leave = through_box(flat)
        count = math.ceil(float((leave - enter).max().clamp_min(self.step)) / self.step) + 1
        shift = shift.expand(rays.shape).reshape(-1, 1)
        depths = enter[:, None] + self.step * (shift + torch.arange(count, device=rays.device))
        ray = (flat.origin, flat.direction)
        return _march(self.field, ray, flat, depths, opaque_end=False).reshape(*rays.shape)


def _march(
    field: Voxels,
    ray: tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]],
    flat: Rays,
    depths: Float[Tensor, "b s"],
    *,
    opaque_end: bool,
) -> Radiance:
    """Radiance of rays whose origins and directions, in the space of the field, are `ray`."""
    grids = list(field.static), list(field.moving), list(field.rows)
    time = 2 * flat.time - 1 if len(field.moving) else None  # 0...1 to -1...1
    depths = depths.contiguous()
    seen = march_voxels(*field.in_box(*ray), depths, *grids, time, opaque_end=opaque_end)
    rgb, behind = seen[:, :3], field.background()
    if behind is not None:
        rgb = rgb + (1 - seen[:, 4:]) * behind
    return Radiance(rgb, seen[:, 3], seen[:, 4], flat.weight)


def through_box(rays: Rays) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"]]:
    """Depths where rays enter and leave the box from -1 to 1; both 0 for those that miss it."""
    toward = torch.where(rays.direction.abs() < 1e-9, 1e-9, rays.direction)
    sides = torch.stack([(-1 - rays.origin) / toward, (1 - rays.origin) / toward])  # [2, b, 3]
    enter = sides.amin(0).amax(-1).clamp_min(0)
    leave = sides.amax(0).amin(-1)
    hit = leave > enter
    return torch.where(hit, enter, 0), torch.where(hit, leave, 0)
