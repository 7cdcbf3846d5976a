"""Light along rays through a field over space and time, in even steps through a box."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from sharpfield.core.rays import Radiance, Rays
from sharpfield.ops.space_time_march import march_through_time


@runtime_checkable
class SpaceTime(Protocol):
    """Raw density and colour in a box, see `ops.space_time_march`."""

    @property
    def still(self) -> Sequence[Tensor]:
        """Grids of what stands still."""
        ...

    @property
    def moving(self) -> Sequence[Tensor]:
        """Values of what moves."""
        ...

    @property
    def rows(self) -> Sequence[Tensor]:
        """Which cells have them."""
        ...

    def background(self) -> Float[Tensor, "3"]:
        """Light from behind the box."""
        ...


@dataclass(frozen=True)
class ThroughBox:
    """Volume rendering of a box from -1 to 1 in steps of one length, before a background.

    When a generator is given, which training does, the steps of a ray are shifted by a random part
    of one. All rays of one measurement are shifted alike, so that what does not change between them
    looks exactly the same.
    """

    field: SpaceTime
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
        place = enter[:, None] + self.step * (shift + torch.arange(count, device=rays.device))
        seen = march_through_time(
            flat.origin,
            flat.direction,
            2 * flat.time - 1,
            place.contiguous(),
            list(self.field.still),
            list(self.field.moving),
            list(self.field.rows),
        )
        rgb = seen[:, :3] + (1 - seen[:, 4:]) * self.field.background()
        return Radiance(rgb, seen[:, 3], seen[:, 4], flat.weight).reshape(*rays.shape)


def through_box(rays: Rays) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"]]:
    """Where rays enter and leave the box from -1 to 1; both 0 for those that miss it."""
    toward = torch.where(rays.direction.abs() < 1e-9, 1e-9, rays.direction)
    sides = torch.stack([(-1 - rays.origin) / toward, (1 - rays.origin) / toward])
    enter = sides.amin(0).amax(-1).clamp_min(0)
    leave = sides.amax(0).amin(-1)
    hit = leave > enter
    return torch.where(hit, enter, 0), torch.where(hit, leave, 0)
