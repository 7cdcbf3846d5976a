"""From the neural points around a place to density, to a feature, and to colour.

Each neighbour is read by two small networks: the first sees its descriptor and the way to it, the
second also its colour and the direction it was seen from. What they say is averaged, nearer
neighbours counting more and unsure ones less; then a third network sees the viewing direction and
makes the *feature*, from which one layer makes the colour.

Source: Point-NeRF (CVPR 2022), section 4; sizes and order of inputs from the released code of
Hybrid Neural Rendering (CVPR 2023).
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from sharpfield.core.seed import generator
from sharpfield.fields.points.cloud import Attributes, NeuralPoints
from sharpfield.ops.dense import LeakyLayers, leaky
from sharpfield.ops.knn import first_near, neighbours
from sharpfield.ops.sparse_rows import compact, take_rows

NEAREST = 1e-6
"""Neighbours count as at least this far away, in world units."""

RIM = (1.002, -0.001)
"""Colours are this times a sigmoid, plus that: black and white can be reached."""


@dataclass(frozen=True)
class PointSizes:
    """Networks around points. Defaults: Hybrid Neural Rendering's."""

    channels: int = 32
    """Of a descriptor."""
    width: int = 256
    """Of the networks that read neighbours."""
    feature: int = 128
    """Of the network that sees the viewing direction."""
    octaves: tuple[int, int, int] = (3, 5, 4)
    """Frequencies in the encoding of descriptors, of ways to neighbours, and of directions."""
    axes: Literal["camera", "world"] = "camera"
    """Ways are told along the camera's axes as well as the world's, and directions reach up to the
    plane at depth 1, as published; or world and unit directions alone."""
    average: Literal["late", "early"] = "late"
    """Neighbours are averaged after both networks, as published, or after their first layers, which
    costs a fraction."""
    unit: float = 1.0
    """Ways are told in this many world units."""
    neighbours: int = 8
    """Most that are asked."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """What the networks compute in."""


def interleaved(x: Float[Tensor, "*b d"], octaves: int) -> Float[Tensor, "*b f"]:
    """[sin x0, cos x0, sin 2 x0, cos 2 x0, ..., sin x1, ...], f = 2 d L, without x itself."""
    angle = x[..., None] * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-3)


def waves(x: Float[Tensor, "*b d"], octaves: int) -> Float[Tensor, "*b f"]:
    """All sines, [sin x0, sin 2 x0, ..., sin x1, ...], then all cosines in the same order."""
    angle = x[..., None] * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    return torch.cat([angle.flatten(-2).sin(), angle.flatten(-2).cos()], -1)


class PointField(nn.Module):
    """Neural points with the networks that read them.

    Args:
        sizes: Of the networks.
        points: What is read.
        radius: Neighbours are closer than this.
        seed: Of the run.
    """

    def __init__(
        self, sizes: PointSizes, points: NeuralPoints, *, radius: float, seed: int
    ) -> None:
        super().__init__()
        self.sizes, self.points, self.radius = sizes, points, radius
        colours = points.colours.shape[1]
        of_descriptor, of_way, of_direction = sizes.octaves
        axes = 6 if sizes.axes == "camera" else 3
        read = sizes.channels * (1 + 2 * of_descriptor) + axes * 2 * of_way
        made = generator(seed, 0, "point networks")
        self.reading = LeakyLayers([read, sizes.width, sizes.width], generator=made)
        seen = sizes.width + colours + 4
        self.seeing = LeakyLayers([seen, sizes.width, sizes.width], generator=made)
        self.to_density = LeakyLayers([sizes.width, 1], generator=made, ends="linear")
        layers = [sizes.width + 6 * of_direction, *3 * [sizes.feature]]
        self.to_feature = LeakyLayers(layers, generator=made)

    def near(
        self,
        origin: Float[Tensor, "b 3"],
        direction: Float[Tensor, "b 3"],
        place: Float[Tensor, "b d"],
        most: int,
    ) -> tuple[Int64[Tensor, "b s"], Float[Tensor, "b s 3"]]:
        """The first places on rays that lie near points, see `ops.knn.first_near`."""
        return first_near(origin, direction, place, self.points.cells(), most)

    def neighbours(
        self, places: Float[Tensor, "q 3"]
    ) -> tuple[Int64[Tensor, "q k"], Float[Tensor, "q k 3"]]:
        """Rows of the points around places and the ways to them, see `ops.knn.neighbours`."""
        positions, cells = self.points.positions, self.points.cells()
        return neighbours(places, positions, cells, self.sizes.neighbours, self.radius)

    def density(
        self,
        rows: Int64[Tensor, "q k"],
        way: Float[Tensor, "q k 3"],
        direction: Float[Tensor, "q 3"],
        turn: Float[Tensor, "q 3 3"] | None = None,
    ) -> tuple[Float[Tensor, "q"], Float[Tensor, "q h"]]:
        """Density, and what the feature is made from.

        Args:
            rows: Neighbours of each place, -1 where there is none.
            way: From the place to each.
            direction: In which the place is looked at; its length matters.
            turn: Camera-from-world rotation, for ways along the camera's axes.
        """
        taken, place = compact(rows.clamp_min(0))
        own = self.points.take(taken)
        share = shares(way, rows >= 0) * own.confidence[place, 0]
        told, seen = self._read(own, place, way, turn), self._seen(own, place, direction)
        if self.sizes.average == "early":
            total = share.sum(-1)
            even = share / total[:, None].clamp_min(NEAREST)
            hidden = self._both(averaged(told, even), averaged(seen, even))
            return total * self._thick(hidden), hidden
        hidden = self._both(told, seen)
        return (share * self._thick(hidden)).sum(-1), averaged(hidden, share)

    def feature(
        self, hidden: Float[Tensor, "n h"], direction: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n f"]:
        """What colour is made from."""
        encoded = waves(direction, self.sizes.octaves[2]).to(hidden.dtype)
        return self.to_feature(hidden, encoded)

    def mean_colour(
        self, rows: Int64[Tensor, "n k"], way: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "n c"]:
        """Of the points around places, nearer ones counting more."""
        taken, place = compact(rows.clamp_min(0))
        colours = take_rows(self.points.colours, taken)
        around = colours.index_select(0, place.flatten()).view(*place.shape, colours.shape[-1])
        return averaged(around, shares(way, rows >= 0)).clamp(0, 1)

    def _read(
        self,
        own: Attributes,
        place: Int64[Tensor, "q k"],
        way: Float[Tensor, "q k 3"],
        turn: Float[Tensor, "q 3 3"] | None,
    ) -> Float[Tensor, "q k h"]:
        """The first layer: what a point says is worked out once, however many look at it."""
        if self.sizes.axes == "camera":
            assert turn is not None, "ways along the camera's axes need its rotation"
            way = torch.cat([way, way @ turn.mT], -1)
        ways = interleaved(way / self.sizes.unit, self.sizes.octaves[1]).to(self.precision)
        parts = [own.descriptors, interleaved(own.descriptors, self.sizes.octaves[0])]
        point = torch.cat(parts, -1).to(self.precision)
        told = self.reading.first(point).index_select(0, place.flatten())
        told = told.view(*place.shape, told.shape[-1])
        return leaky(told + self.reading.first(ways, skipped=point.shape[-1]))

    def _seen(
        self, own: Attributes, place: Int64[Tensor, "q k"], direction: Float[Tensor, "q 3"]
    ) -> Float[Tensor, "q k s"]:
        """Colours of points, and how the directions they were first seen from differ from ours."""
        known = torch.cat([own.colours, own.directions], -1)
        known = known.index_select(0, place.flatten()).view(*place.shape, known.shape[-1])
        colour, first = known[..., :-3], known[..., -3:]
        along = (first * direction[:, None]).sum(-1, keepdim=True)
        return torch.cat([colour, first - direction[:, None], along], -1).to(self.precision)

    def _both(
        self, told: Float[Tensor, "*q h"], seen: Float[Tensor, "*q s"]
    ) -> Float[Tensor, "*q h"]:
        """All layers after the first."""
        return self.seeing(self.reading.rest(told), seen)

    def _thick(self, hidden: Float[Tensor, "*q h"]) -> Float[Tensor, "*q"]:
        return nn.functional.softplus(self.to_density(hidden)[..., 0].float() - 1)

    @property
    def precision(self) -> torch.dtype:
        """What the networks compute in."""
        return getattr(torch, self.sizes.precision)


class ColourHead(nn.Module):
    """One layer from a feature to a colour as frames store it.

    Args:
        feature: Its width.
        colours: 1 or 3.
        seed: Of the run.
    """

    def __init__(self, feature: int, colours: int, *, seed: int) -> None:
        super().__init__()
        made = generator(seed, 0, "colour head")
        self.layer = LeakyLayers([feature, colours], generator=made, ends="linear")

    def forward(
        self, feature: Float[Tensor, "n f"], start: Float[Tensor, "n c"] | None = None
    ) -> Float[Tensor, "n c"]:
        """A little below 0 to a little above 1.

        Args:
            feature: Of each place.
            start: Colours that the network adds to, in log odds; 0...1.
        """
        raw = self.layer(feature).float()
        if start is not None:
            raw = raw + torch.logit(start, eps=1e-2)
        return RIM[0] * raw.sigmoid() + RIM[1]


def shares(way: Float[Tensor, "q k 3"], there: Bool[Tensor, "q k"]) -> Float[Tensor, "q k"]:
    """How much each neighbour counts: inversely to its distance, one in sum where there is any."""
    near = there / way.norm(dim=-1).clamp_min(NEAREST)
    return near / near.sum(-1, keepdim=True).clamp_min(1e-8)


def averaged(values: Float[Tensor, "q k h"], share: Float[Tensor, "q k"]) -> Float[Tensor, "q h"]:
    """Sum over neighbours by share."""
    return (share[:, None].to(values.dtype) @ values)[:, 0]
