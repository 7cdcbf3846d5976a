"""A neural point field: density, feature and colour from the learned points around a position.

A *neural point* has a fixed position and learned *attributes*: a *descriptor*, which is the input
of networks, a *confidence* that it is on a surface, a colour, and the direction from which it was
first seen. Colours are stored values, not light. Two small networks process each neighbour: the
first reads its descriptor and the offset to it, the second also its colour and first direction.
Their outputs are averaged with weights by inverse distance and confidence; a third network adds the
viewing direction and gives the *feature*, from which one layer computes the colour.

Source: Point-NeRF (CVPR 2022), sections 3 and 4; attributes, sizes and order of inputs from the
released code of Hybrid Neural Rendering (CVPR 2023).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Generator, Tensor, nn

from sharpfield.core.seed import generator
from sharpfield.ops.dense import LeakyLayers, compact, leaky, take_rows
from sharpfield.ops.knn import Cells, first_near, neighbours, sort_into_cells

LEAST_CONFIDENCE = 1e-4
"""Confidences are clamped to at least this and at most 1 where used; their gradients pass."""


@dataclass(frozen=True)
class Attributes:
    """Attributes of some points."""

    descriptors: Float[Tensor, "n f"]
    confidence: Float[Tensor, "n 1"]
    """Clamped."""
    colours: Float[Tensor, "n c"]
    directions: Float[Tensor, "n 3"]


class NeuralPoints(nn.Module):
    """Neural points, one row for each in every tensor.

    Args:
        positions: In world units.
        descriptors: Of any width.
        confidence: 0...1.
        colours: 1 or 3 channels, as frames store them.
        directions: Unit vectors from a camera to each point.
        cell: Edge of the cells in which neighbours are looked up.
    """

    positions: Tensor

    def __init__(
        self,
        positions: Float[Tensor, "n 3"],
        descriptors: Float[Tensor, "n f"],
        confidence: Float[Tensor, "n 1"],
        colours: Float[Tensor, "n c"],
        directions: Float[Tensor, "n 3"],
        *,
        cell: float,
    ) -> None:
        super().__init__()
        self.register_buffer("positions", positions)
        self.descriptors = nn.Parameter(descriptors)
        self.confidence = nn.Parameter(confidence)
        self.colours = nn.Parameter(colours)
        self.directions = nn.Parameter(directions)
        self.cell = cell
        self._sorted: tuple[tuple[int, int, int], Cells] | None = None

    @classmethod
    def start(
        cls,
        positions: Float[Tensor, "n 3"],
        colours: Float[Tensor, "n c"],
        directions: Float[Tensor, "n 3"],
        *,
        channels: int,
        cell: float,
        generator: Generator,
        confidence: float = 1.0,
        spread: float = 0.5,
    ) -> "NeuralPoints":
        """Points whose descriptors are uniform from -`spread` to `spread`."""
        count = len(positions)
        descriptors = spread * (2 * torch.rand(count, channels, generator=generator) - 1)
        sure = torch.full((count, 1), confidence)
        return cls(positions, descriptors, sure, colours, directions, cell=cell)

    def __len__(self) -> int:
        """Number of points."""
        return len(self.positions)

    def cells(self) -> Cells:
        """The cell lists for neighbour queries, rebuilt when the points have changed."""
        held = self.positions
        stamp = (held.data_ptr(), held._version, len(held))
        if self._sorted is None or self._sorted[0] != stamp:
            self._sorted = stamp, sort_into_cells(held, self.cell)
        return self._sorted[1]

    def take(self, rows: Int64[Tensor, "m"]) -> Attributes:
        """The attributes of some points; ascending, without repetition."""
        confidence = take_rows(self.confidence, rows)
        bounded = confidence.detach().clamp(LEAST_CONFIDENCE, 1)
        return Attributes(
            take_rows(self.descriptors, rows),
            bounded + confidence - confidence.detach(),  # gradients pass the bounds
            take_rows(self.colours, rows),
            take_rows(self.directions, rows),
        )

    def points(self) -> dict[str, Tensor]:
        """All parameters and buffers with one row for each point, by name."""
        return {"positions": self.positions, **dict(self.named_parameters())}

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Replace all points, by any number of others; all parameters are new objects.

        Args:
            points: By the names of `points`, with the same rows.
        """
        for name, values in points.items():
            if name == "positions":
                self.positions = values
                continue
            learns = getattr(self, name).requires_grad
            setattr(self, name, nn.Parameter(values.detach(), requires_grad=learns))


NEAREST = 1e-6
"""Smallest distance of a neighbour in the weights, in world units."""

RIM = (1.002, -0.001)
"""Factor and offset of the sigmoid of colours, so that black and white can be reached."""


@dataclass(frozen=True)
class PointSizes:
    """Networks around points. Defaults: Hybrid Neural Rendering's."""

    channels: int = 32
    """Of a descriptor."""
    width: int = 256
    """Of the networks of neighbours."""
    feature: int = 128
    """Of the network with the viewing direction."""
    octaves: tuple[int, int, int] = (3, 5, 4)
    """Frequencies in the encoding of descriptors, of offsets to neighbours, and of directions."""
    axes: Literal["camera", "world"] = "camera"
    """Offsets are given along the camera's axes and the world's, and directions end at the plane at
    depth 1, as published; or only along the world's, with unit directions."""
    average: Literal["late", "early"] = "late"
    """Neighbours are averaged after both networks, as published, or after their first layers, which
    costs a fraction."""
    unit: float = 1.0
    """Unit of offsets, in world units."""
    neighbours: int = 8
    """Most neighbours of a position."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the computation of the networks."""


def interleaved(x: Float[Tensor, "*b d"], octaves: int) -> Float[Tensor, "*b f"]:
    """[sin x0, cos x0, sin 2 x0, cos 2 x0, ..., sin x1, ...], f = 2 d L, without x itself."""
    angle = x[..., None] * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-3)


def waves(x: Float[Tensor, "*b d"], octaves: int) -> Float[Tensor, "*b f"]:
    """All sines, [sin x0, sin 2 x0, ..., sin x1, ...], then all cosines in the same order."""
    angle = x[..., None] * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    return torch.cat([angle.flatten(-2).sin(), angle.flatten(-2).cos()], -1)


class PointField(nn.Module):
    """Neural points with their networks.

    Args:
        sizes: Of the networks.
        points: The neural points.
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
        """The first samples on rays that are near points, see `ops.knn.first_near`."""
        return first_near(origin, direction, place, self.points.cells(), most)

    def neighbours(
        self, places: Float[Tensor, "q 3"]
    ) -> tuple[Int64[Tensor, "q k"], Float[Tensor, "q k 3"]]:
        """Rows of the points around positions, and offsets to them, see `ops.knn.neighbours`."""
        positions, cells = self.points.positions, self.points.cells()
        return neighbours(places, positions, cells, self.sizes.neighbours, self.radius)

    def density(
        self,
        rows: Int64[Tensor, "q k"],
        way: Float[Tensor, "q k 3"],
        direction: Float[Tensor, "q 3"],
        turn: Float[Tensor, "q 3 3"] | None = None,
    ) -> tuple[Float[Tensor, "q"], Float[Tensor, "q h"]]:
        """Density, and the hidden layer from which the feature is computed.

        Args:
            rows: Neighbours of each position, -1 where there is none.
            way: Offset from the position to each.
            direction: Viewing direction; not normalised.
            turn: Camera-from-world rotation, for offsets along the camera's axes.
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
        """The feature from which colour is computed."""
        encoded = waves(direction, self.sizes.octaves[2]).to(hidden.dtype)
        return self.to_feature(hidden, encoded)

    def mean_colour(
        self, rows: Int64[Tensor, "n k"], way: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "n c"]:
        """Mean colour of the points around positions, weighted by inverse distance."""
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
        """The first layer: the part of a point is computed once for all positions near it."""
        if self.sizes.axes == "camera":
            assert turn is not None, "offsets along the camera's axes need its rotation"
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
        """Colours of points, and their first viewing directions relative to the present one."""
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
        """Of the computation of the networks."""
        return getattr(torch, self.sizes.precision)


class ColourHead(nn.Module):
    """One layer from a feature to a colour, a stored value.

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
            feature: Of each position.
            start: Colours, 0...1, to whose logits the network's output is added.
        """
        raw = self.layer(feature).float()
        if start is not None:
            raw = raw + torch.logit(start, eps=1e-2)
        return RIM[0] * raw.sigmoid() + RIM[1]


def shares(way: Float[Tensor, "q k 3"], there: Bool[Tensor, "q k"]) -> Float[Tensor, "q k"]:
    """Weights of neighbours: inverse distances, which sum to one where there is any neighbour."""
    near = there / way.norm(dim=-1).clamp_min(NEAREST)
    return near / near.sum(-1, keepdim=True).clamp_min(1e-8)


def averaged(values: Float[Tensor, "q k h"], share: Float[Tensor, "q k"]) -> Float[Tensor, "q h"]:
    """Weighted sum over neighbours."""
    return (share[:, None].to(values.dtype) @ values)[:, 0]
