"""Light along rays through a cloud of neural points.

Rays are looked at in small steps; the first steps that come near a point are *asked*, each by the
points around it. What is asked has a density; it stops light as if it were one voxel thick, however
long the step. Colours are only worked out where light comes from, and blended as frames store them.
A ray that comes near no point at all has *missed*: it shows the background.

Source: Point-NeRF (CVPR 2022), section 4.1. In the released code the thickness comes about because
steps are longer than two voxels, which it takes for gaps.
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

UNSEEN = 1e-4
"""In evaluation, colour is left out where a sample's share of the light is below this."""

SPECK = 1e-7
"""The same in training, where it must not show in any gradient."""

UNEVEN = 0.3
"""Steps differ in length by up to this share in training."""


@runtime_checkable
class Points(Protocol):
    """What rays run through, see `fields.PointField`."""

    def near(
        self,
        origin: Float[Tensor, "b 3"],
        direction: Float[Tensor, "b 3"],
        place: Float[Tensor, "b d"],
        most: int,
    ) -> tuple[Int64[Tensor, "b s"], Float[Tensor, "b s 3"]]:
        """The first of the places on rays that lie near points, and where they are."""
        ...

    def neighbours(
        self, places: Float[Tensor, "q 3"]
    ) -> tuple[Int64[Tensor, "q k"], Float[Tensor, "q k 3"]]:
        """Rows of the points around places, and the ways to them."""
        ...

    def density(
        self,
        rows: Int64[Tensor, "q k"],
        way: Float[Tensor, "q k 3"],
        direction: Float[Tensor, "q 3"],
        turn: Float[Tensor, "q 3 3"] | None = None,
    ) -> tuple[Float[Tensor, "q"], Float[Tensor, "q h"]]:
        """Density of places, and what their colour is made from."""
        ...


@dataclass(frozen=True)
class Asked(Struct):
    """Places on rays that send light."""

    trailing: ClassVar = dict.fromkeys(("place", "rows", "way", "hidden", "direction"), 1) | {
        "way": 2
    }

    ray: Int64[Tensor, "*n"]
    """Number of the ray each lies on."""
    place: Float[Tensor, "*n 3"]
    rows: Int64[Tensor, "*n k"]
    """Points around it, -1 where there are no more."""
    way: Float[Tensor, "*n k 3"]
    """To each of them."""
    hidden: Float[Tensor, "*n h"]
    """What its colour is made from."""
    direction: Float[Tensor, "*n 3"]
    """In which it is looked at; its length matters."""


Colour = Callable[[Asked], Float[Tensor, "n c"]]
"""From places to their colours, as frames store them."""


@dataclass(frozen=True)
class Met:
    """What rays met."""

    colour: Float[Tensor, "b c"]
    """As frames store it."""
    depth: Float[Tensor, "b"]
    """Expected ray parameter; along the camera's axis where rays have its rotation."""
    opacity: Float[Tensor, "b"]
    hit: Bool[Tensor, "b"]
    """Whether any point was near."""
    rows: Int64[Tensor, "n k"]
    """Points around all places that were asked."""
    densest: Float[Tensor, "b"]
    """The largest opacity of a single place."""
    where: Float[Tensor, "b 3"]
    """That place."""


@dataclass(frozen=True)
class PointMarch:
    """How rays run through points."""

    points: Points
    near: float
    """Ray parameter where steps begin."""
    far: float
    steps: int = 400
    asked: int = 24
    """Most places of a ray near which points are looked for."""
    thickness: float = 0.008
    """Of what stops light at each place: opacity is 1 - exp(-density thickness)."""
    background: float = 1.0
    """Behind everything, as frames store it."""

    def __call__(
        self,
        rays: Rays,
        colour: Colour,
        *,
        turn: Float[Tensor, "b 3 3"] | None = None,
        generator: Generator | None = None,
    ) -> Met:
        """What rays meet.

        Args:
            rays: On one leading axis.
            colour: Of the places that send light.
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
        share = weights.flatten()[asked]
        seen = torch.nonzero(share > (SPECK if torch.is_grad_enabled() else UNSEEN))[:, 0]
        at = asked[seen]
        light = colour(
            Asked(
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
        return Met(
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
