"""Light along rays through a voxel grid, in even steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Generator, Tensor

from sharpfield.core.rays import Radiance, Rays
from sharpfield.geometry.space import Frustum, Space
from sharpfield.ops import stepfun
from sharpfield.ops.voxel_march import march


@runtime_checkable
class Grid(Protocol):
    """Raw density and colour in a box, see `ops.voxel_march`."""

    def cells(self) -> Sequence[Tensor]:
        """Grids that add up."""
        ...

    def place(
        self, origin: Float[Tensor, "b 3"], direction: Float[Tensor, "b 3"]
    ) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]]:
        """Rays in box coordinates."""
        ...


@dataclass(frozen=True)
class EvenSteps:
    """Volume rendering of a voxel grid; every sample stands for one step.

    Samples are jittered inside their steps when a generator is given, which training does.
    """

    field: Grid
    space: Space
    samples: int = 96
    clear_before: float = 0.0
    """In evaluation, nothing before this ray parameter is seen."""

    def __call__(
        self, rays: Rays, generator: Generator | None = None, *, samples: bool = False
    ) -> Radiance:
        """Radiance of rays of any shape; there are no features to keep."""
        flat = rays.reshape(-1)
        origin, direction = self.field.place(*self.space.warp(flat))
        seen = march(
            origin,
            direction,
            self._depths(flat, generator),
            self.field.cells(),
            opaque_end=isinstance(self.space, Frustum),
        )
        found = Radiance(seen[:, :3], seen[:, 3], seen[:, 4], flat.weight)
        return found.reshape(*rays.shape)

    def _depths(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "b s"]:
        near, far = self.space.near, self.space.far
        if generator is None:
            place = stepfun.even_positions(rays.shape, 2 * self.samples + 1, rays.device)
            place = place[:, 1::2]  # middles of the steps
            place = place[:, near + (far - near) * place[0] > self.clear_before]
        else:
            place = stepfun.stratified_positions(rays.shape, self.samples, generator)
        return (near + (far - near) * place).contiguous()
