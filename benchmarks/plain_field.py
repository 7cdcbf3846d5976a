"""The published planes and lines with their heads, in straightforward torch: channel first.

They take the parameters of ours. What they do that ours avoid is marked by "Plain:".

Source: PDRF (AAAI 2023) and TensoRF (ECCV 2022), as Ev-DeblurNeRF (CVPR 2024) uses them.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.fields.plane_grid import PlaneField, PlaneHead, Volume


class PlainVolume(nn.Module):
    """Planes `[1, c, h, w]` and lines `[1, c, l, 1]`, looked up one by one."""

    AXES = (((0, 1), 2), ((0, 2), 1), ((1, 2), 0))
    """Of each pair: columns and rows of the plane, and the line."""

    def __init__(self, volume: Volume) -> None:
        super().__init__()
        self.box: Tensor
        self.register_buffer("box", volume.box)
        self.planes = nn.ParameterList(copied(p.permute(2, 0, 1)[None]) for p in volume.planes)
        self.lines = nn.ParameterList(copied(line.T[None, ..., None]) for line in volume.lines)
        self.basis = layer(volume.basis.weight)

    def forward(self, points: Float[Tensor, "b s 3"]) -> Float[Tensor, "b s f"]:
        """Features at points."""
        low, high = self.box
        place = ((points - low) / (high - low) * 2 - 1).reshape(-1, 3)
        on_planes, on_lines = [], []
        for ((column, row), along), plane, line in zip(
            self.AXES, self.planes, self.lines, strict=True
        ):
            zero = torch.zeros_like(place[:, along])
            on_planes.append(sampled(plane, torch.stack([place[:, column], place[:, row]], -1)))
            on_lines.append(sampled(line, torch.stack([zero, place[:, along]], -1)))
        # Plain: three tensors of 96 numbers per point.
        features = (torch.cat(on_planes) * torch.cat(on_lines)).T
        return self.basis(features).reshape(*points.shape[:-1], -1)

    def roughness(self) -> Float[Tensor, ""]:
        """Total variation, 5 (0.01 planes + 0.001 lines)."""
        planes = torch.stack([total_variation(plane) for plane in self.planes]).sum()
        lines = torch.stack([total_variation(line) for line in self.lines]).sum()
        return 5 * (1e-2 * planes + 1e-3 * lines)


class PlainHead(nn.Module):
    """Density and colour of points, every point with its own copy of the direction's encoding."""

    def __init__(self, head: PlaneHead) -> None:
        super().__init__()
        self.octaves = head.position, head.direction
        self.density = nn.ModuleList(layer(part.weight) for part in (head.inside, head.out))
        first = torch.cat([head.first.of_sample, head.first.of_ray], 1)
        last = [part.weight for part in head.last.layers]
        self.colour = nn.ModuleList(layer(weight) for weight in (first, *last))

    def forward(
        self,
        looked: Float[Tensor, "b s f"],
        points: Float[Tensor, "b s 3"],
        direction: Float[Tensor, "b 3"],
    ) -> tuple[Float[Tensor, "b s"], Float[Tensor, "b s 3"], Float[Tensor, "b s h"]]:
        """Raw density, colour, and the features in between."""
        position, turn = self.octaves
        out = self._through(self.density, torch.cat([looked, encoded(points, position)], -1))
        raw, feature = out[..., 0], out[..., 1:]
        # Plain: encoded for every sample of a ray.
        seen = encoded(direction[:, None].expand_as(points), turn)
        rgb = torch.sigmoid(self._through(self.colour, torch.cat([feature, seen], -1)))
        return raw, rgb, feature

    @staticmethod
    def _through(layers: nn.ModuleList, x: Tensor) -> Tensor:
        for number, part in enumerate(layers):
            x = part(torch.relu(x) if number else x)
        return x


class PlainField(nn.Module):
    """Two volumes with a head each."""

    def __init__(self, field: PlaneField) -> None:
        super().__init__()
        coarse, fine = field.volumes
        self.coarse_volume, self.fine_volume = PlainVolume(coarse), PlainVolume(fine)
        self.coarse, self.fine = PlainHead(field.coarse), PlainHead(field.fine)

    def roughness(self) -> Float[Tensor, ""]:
        """Of both volumes."""
        return self.coarse_volume.roughness() + self.fine_volume.roughness()


def encoded(x: Float[Tensor, "*b d"], octaves: int) -> Float[Tensor, "*b f"]:
    """[x, sin x, cos x, sin 2x, cos 2x, ...]."""
    waves = [wave(2.0**octave * x) for octave in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], -1)


def sampled(grid: Float[Tensor, "1 c h w"], place: Float[Tensor, "n 2"]) -> Float[Tensor, "c n"]:
    """Bilinear, zero outside."""
    found = F.grid_sample(grid, place[None, :, None], padding_mode="zeros", align_corners=True)
    return found[0, ..., 0]


def total_variation(grid: Float[Tensor, "1 c h w"]) -> Float[Tensor, ""]:
    """Twice the mean squared difference, down and to the right."""
    down = (grid[:, :, 1:] - grid[:, :, :-1]).square().mean()
    if grid.shape[3] == 1:
        return 2 * down
    return 2 * (down + (grid[..., 1:] - grid[..., :-1]).square().mean())


def copied(value: Tensor) -> nn.Parameter:
    """A parameter with memory of its own."""
    return nn.Parameter(value.detach().clone(memory_format=torch.contiguous_format))


def layer(weight: Float[Tensor, "o i"]) -> nn.Linear:
    """A linear layer without bias."""
    made = nn.Linear(*reversed(weight.shape), bias=False, device="meta")
    made.weight = copied(weight)
    return made
