"""Volume rendering of a cloud of neural points.

Rays are sampled in small steps; the first samples near a point are *shaded*, each from the points
around it. A shaded sample has a density and absorbs light as if it were one voxel thick, however
long the step. Colours are computed only where the weight is not negligible, and blended as stored
values. A ray without any near point is a *miss* and has the background's colour.

Source: Point-NeRF (CVPR 2022), section 4.1. In the released code the thickness results from steps
longer than two voxels, which it treats as gaps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Generator, Tensor

from sharpfield.core.rays import Rays
from sharpfield.core.struct import Struct
from sharpfield.ops import compositing
from sharpfield.rendering.coarse_to_fine import MIN_WEIGHT_EVAL, MIN_WEIGHT_TRAIN

UNEVEN = 0.3
"""In training, the length of steps varies by up to this fraction."""


@runtime_checkable
class Points(Protocol):
    """A field of points, see `fields.points.networks.PointField`."""

    def near(
        self,
        origin: Float[Tensor, "b 3"],
        direction: Float[Tensor, "b 3"],
        place: Float[Tensor, "b d"],
        most: int,
    ) -> tuple[Int64[Tensor, "b s"], Float[Tensor, "b s 3"]]:
        """The first of the samples on rays that are near points, and their positions."""
        ...

    def neighbours(
        self, places: Float[Tensor, "q 3"]
    ) -> tuple[Int64[Tensor, "q k"], Float[Tensor, "q k 3"]]:
        """Rows of the points around positions, and the offsets to them."""
        ...

    def density(
        self,
        rows: Int64[Tensor, "q k"],
        way: Float[Tensor, "q k 3"],
        direction: Float[Tensor, "q 3"],
        turn: Float[Tensor, "q 3 3"] | None = None,
    ) -> tuple[Float[Tensor, "q"], Float[Tensor, "q h"]]:
        """Density at positions, and the hidden features from which colour is computed."""
        ...


@dataclass(frozen=True)
class ShadedSamples(Struct):
    """Samples on rays that have a colour."""

    trailing: ClassVar = dict.fromkeys(("place", "rows", "way", "hidden", "direction"), 1) | {
        "way": 2
    }

    ray: Int64[Tensor, "*n"]
    """Index of the ray of each."""
    place: Float[Tensor, "*n 3"]
    rows: Int64[Tensor, "*n k"]
    """Points around it, -1 where there are no more."""
    way: Float[Tensor, "*n k 3"]
    """Offset to each of them."""
    hidden: Float[Tensor, "*n h"]
    """Features from which its colour is computed."""
    direction: Float[Tensor, "*n 3"]
    """Of the ray; not normalised."""


Colour = Callable[[ShadedSamples], Float[Tensor, "n c"]]
"""From samples to their colours, as stored values."""


@dataclass(frozen=True)
class PointRadiance:
    """The result for each ray."""

    colour: Float[Tensor, "b c"]
    """Stored values."""
    depth: Float[Tensor, "b"]
    """Expected ray parameter; along the camera's axis where rays have its rotation."""
    opacity: Float[Tensor, "b"]
    hit: Bool[Tensor, "b"]
    """Whether any point was near."""
    rows: Int64[Tensor, "n k"]
    """Points around all shaded samples."""
    densest: Float[Tensor, "b"]
    """The largest opacity of a single sample."""
    where: Float[Tensor, "b 3"]
    """Position of that sample."""


@dataclass(frozen=True)
class PointMarch:
    """Volume rendering along rays through points."""

    points: Points
    near: float
    """Ray parameter of the first step."""
    far: float
    steps: int = 400
    asked: int = 24
    """Most shaded samples of a ray."""
    thickness: float = 0.008
    """Of the absorbing voxel at each sample: opacity is 1 - exp(-density thickness)."""
    background: float = 1.0
    """Colour behind everything, a stored value."""

    def __call__(
        self,
        rays: Rays,
        colour: Colour,
        *,
        turn: Float[Tensor, "b 3 3"] | None = None,
        generator: Generator | None = None,
    ) -> PointRadiance:
        """Colour, depth and opacity of rays.

        Args:
            rays: On one leading axis.
            colour: Computes the colour of samples.
            turn: Camera-from-world rotations. Directions then reach up to the plane at depth 1, so
                that the ray parameter is depth.
            generator: Makes steps uneven, for training.
        """
        direction = rays.direction
        if turn is not None:
            direction = direction / (turn[:, 2] * direction).sum(-1, keepdim=True)
        depth = self._depths(rays, generator)
        which, places = self.points.near(rays.origin, direction, depth, self.asked)
        candidate = torch.nonzero((which >= 0).flatten())[:, 0]
        rows, way = self.points.neighbours(places.flatten(0, 1)[candidate])
        alive = torch.nonzero(rows[:, 0] >= 0)[:, 0]
        asked, rows, way = candidate[alive], rows[alive], way[alive]
        ray = asked // self.asked
        of_place = None if turn is None else turn[ray]
        density, hidden = self.points.density(rows, way, direction[ray], of_place)
        spread = density.new_zeros(which.numel()).index_copy(0, asked, density)
        spread = spread.view(which.shape)
        weights = compositing.weigh(spread, torch.full_like(spread, self.thickness))
        least = MIN_WEIGHT_TRAIN if torch.is_grad_enabled() else MIN_WEIGHT_EVAL
        seen = torch.nonzero(weights.flatten()[asked] > least)[:, 0]
        at = asked[seen]
        light = colour(
            ShadedSamples(
                ray[seen],
                places.flatten(0, 1)[at],
                rows[seen],
                way[seen],
                hidden[seen],
                direction[ray[seen]],
            )
        )
        opacity = weights.sum(-1)
        mixed = compositing.gather_kept(weights, at, light)
        hit = torch.zeros_like(opacity, dtype=torch.bool).index_fill(0, ray, True)
        densest, best = spread.detach().max(-1)
        return PointRadiance(
            colour=mixed + self.background * (1 - opacity)[:, None],
            depth=(weights * depth.gather(-1, which.clamp_min(0))).sum(-1),
            opacity=opacity,
            hit=hit,
            rows=rows,
            densest=1 - torch.exp(-densest * self.thickness),
            where=places.gather(1, best[:, None, None].expand(-1, 1, 3))[:, 0],
        )

    def _depths(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "b d"]:
        """Middles of the steps."""
        step = (self.far - self.near) / self.steps
        if generator is None:
            even = torch.arange(self.steps, device=rays.device) + 0.5
            return (self.near + step * even).expand(len(rays), -1)
        drawn = torch.rand(len(rays), self.steps, generator=generator, device=rays.device)
        length = step * (1 + UNEVEN * (drawn - 0.5))
        return self.near + length.cumsum(-1) - length / 2
