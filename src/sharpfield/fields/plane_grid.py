"""A field of factored feature volumes with a small network on each: fast, and sharp.

A *volume* is three planes times three lines of features (vector-matrix factorisation, TensoRF,
ECCV 2022). The coarse head sees one volume, the fine head that one and a finer one (PDRF, AAAI
2023); both also get the frequency-encoded position. Positions are those of the renderer's space.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.ops.dense import Dense, SplitLinear, apply_linear, linear
from sharpfield.ops.encoding import frequencies, frequencies_width
from sharpfield.ops.grid import grid_shape, plane_line_mixture

CHANNELS = (64, 16, 16)
"""Features of the xy, xz and yz plane (Ev-DeblurNeRF's recipes)."""

OCTAVES = (10, 4)
"""Frequencies in the encoding of position and of direction."""


@dataclass(frozen=True)
class HeadSize:
    """Widths of a head: hidden layer of the density network, its features, the colour layers."""

    hidden: int
    feature: int
    colour: int


COARSE = HeadSize(hidden=64, feature=15, colour=64)
FINE = HeadSize(hidden=256, feature=128, colour=256)


class Volume(nn.Module):
    """Features in a box: planes times lines, mixed by one matrix.

    Args:
        box: Low and high corner.
        voxels: How many voxels a dense grid of this resolution would have.
        features: Width of the result.
        generator: Where the first parameters come from.
        channels: Features of the three planes and their lines.
        spread: Standard deviation of the first values.
    """

    box: Float[Tensor, "2 3"]

    def __init__(
        self,
        box: Float[Tensor, "2 3"],
        voxels: int,
        features: int,
        *,
        generator: torch.Generator,
        channels: tuple[int, int, int] = CHANNELS,
        spread: float = 0.1,
    ) -> None:
        super().__init__()
        self.register_buffer("box", box.float(), persistent=False)
        nx, ny, nz = grid_shape(box, voxels)
        xy, xz, yz = channels

        def values(*shape: int) -> nn.Parameter:
            return nn.Parameter(spread * torch.randn(shape, generator=generator))

        self.planes = nn.ParameterList([values(ny, nx, xy), values(nz, nx, xz), values(nz, ny, yz)])
        self.lines = nn.ParameterList([values(nz, xy), values(ny, xz), values(nx, yz)])
        self.basis = linear(sum(channels), features, generator=generator, bias=False)

    def forward(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b f"]:
        """Features at points; zero outside the box, with a fade of one voxel."""
        low, high = self.box
        place = (points - low) * (2 / (high - low)) - 1
        basis = self.basis.weight.T
        return plane_line_mixture(place, list(self.planes), list(self.lines), basis)


class PlaneHead(nn.Module):
    """Density and colour from the features of a volume and the encoded position.

    Args:
        features: Width of the looked-up features.
        size: Widths of the layers.
        generator: Where the first parameters come from.
        octaves: Frequencies in the encoding of position and of direction.
        precision: What the layers compute in; parameters, density and colour stay float32.
    """

    def __init__(
        self,
        features: int,
        size: HeadSize,
        *,
        generator: torch.Generator,
        octaves: tuple[int, int] = OCTAVES,
        precision: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.position, self.direction = octaves
        self.precision = precision
        width = features + frequencies_width(3, self.position)
        self.inside = linear(width, size.hidden, generator=generator, bias=False)
        self.out = linear(size.hidden, size.feature + 1, generator=generator, bias=False)
        self.first = SplitLinear(
            size.feature,
            frequencies_width(3, self.direction),
            size.colour,
            generator=generator,
            bias=False,
        )
        self.last = Dense([size.colour, size.colour, 3], generator=generator, bias=False)

    def density(
        self, features: Float[Tensor, "*b s f"], points: Float[Tensor, "*b s 3"]
    ) -> tuple[Float[Tensor, "*b s"], Float[Tensor, "*b s h"]]:
        """Density before its activation, and the hidden layer."""
        encoded = torch.cat([features, frequencies(points, self.position)], -1)
        hidden = torch.relu(apply_linear(self.inside.weight, None, encoded.to(self.precision)))
        return apply_linear(self.out.weight[:1], None, hidden)[..., 0].float(), hidden

    def feature(self, hidden: Float[Tensor, "*b s h"]) -> Float[Tensor, "*b s f"]:
        """The other outputs of the layer that gives density."""
        return apply_linear(self.out.weight[1:], None, hidden)

    def colour(
        self, feature: Float[Tensor, "*b s f"], direction: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b s 3"]:
        """Linear colour, 0...1."""
        ray = frequencies(direction, self.direction).to(feature.dtype)
        return torch.sigmoid(self.last(torch.relu(self.first(feature, ray))).float())


class PlaneField(nn.Module):
    """A coarse and a fine volume with a head each.

    Args:
        box: Low and high corner of the scene in the renderer's space.
        voxels: Voxels of the coarse and of the fine volume.
        generator: Where the first parameters come from.
        heads: Widths of the coarse and of the fine head.
        features: Width of the features of each volume.
        channels: Features of the planes of both volumes.
        octaves: Frequencies in the encoding of position and of direction.
        precision: What the heads compute in.
    """

    volumes: Sequence[Volume]

    def __init__(
        self,
        box: Float[Tensor, "2 3"],
        voxels: tuple[int, int],
        *,
        generator: torch.Generator,
        heads: tuple[HeadSize, HeadSize] = (COARSE, FINE),
        features: int = 32,
        channels: tuple[int, int, int] = CHANNELS,
        octaves: tuple[int, int] = OCTAVES,
        precision: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        volumes = [
            Volume(box, count, features, generator=generator, channels=channels) for count in voxels
        ]
        self.volumes = cast(Sequence[Volume], nn.ModuleList(volumes))
        self.coarse, self.fine = (
            PlaneHead(width, size, generator=generator, octaves=octaves, precision=precision)
            for width, size in zip((features, 2 * features), heads, strict=True)
        )

    def coarse_features(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s f"]:
        """Features of the coarse volume; the scene is static, so time does not matter."""
        return self.volumes[0](points)

    def fine_features(
        self,
        features: Float[Tensor, "*b s f"],
        old: Float[Tensor, "*b s 3"],
        new: Float[Tensor, "*b m 3"],
        time: Float[Tensor, "*b"],
    ) -> Float[Tensor, "*b t g"]:
        """Features of both volumes; the coarse one's at old points are taken from `features`."""
        wide = torch.cat([features, self.volumes[0](new)], -2)
        close = self.volumes[1](torch.cat([old, new], -2))
        return torch.cat([wide, close], -1)

    def planes(self) -> list[nn.Parameter]:
        """Planes of both volumes."""
        return [plane for volume in self.volumes for plane in volume.planes]

    def lines(self) -> list[nn.Parameter]:
        """Lines of both volumes."""
        return [line for volume in self.volumes for line in volume.lines]
