"""Blur of small patches: simple kernels of which the best is chosen, or one learned for each patch.

A rendered patch is sharp, a recorded one may be blurred. Before they are compared, the rendered one
is blurred by the kernel that makes it most like the recorded one. There is a kernel that does
nothing, so sharp patches stay sharp. Kernels know nothing of cameras or depth.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.2; sizes and rules from the released code.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.seed import generator
from sharpfield.ops.dense import LeakyLayers
from sharpfield.ops.patch import best_match, convolve, convolve_all

PARTS, FINE = 32, 1024
"""Places between pixels are rounded to parts of one, from sums of finer ones, as OpenCV used to do
in rotating images."""

FAINT = 1e-6
"""Least share of a kernel on known pixels that a pixel is divided by."""

Kind = Literal["outward", "through", "both"]
"""Strokes that begin at the pixel (8 directions), go through it (4), or both."""

Edge = Literal["keep", "divide", "still"]
"""What replaces the part of a learned kernel that lies outside the patch: the pixel itself; a
larger weight of the rest; or the latter without a gradient through it."""


def motion_kernels(
    size: int = 9, distances: tuple[int, ...] = (1, 2, 4), *, kind: Kind = "both"
) -> Float[Tensor, "q k k"]:
    """Straight strokes in all directions, each summing to one.

    Args:
        size: Pixels a side; odd.
        distances: How far strokes reach from the pixel.
        kind: Where they begin.
    """
    kernels: list[Tensor] = []
    if kind in ("outward", "both"):
        kernels += [_stroke(size, m, 0, 45 * turn) for m in distances for turn in range(8)]
    if kind in ("through", "both"):
        kernels += [_stroke(size, m, m, 45 * turn) for m in distances for turn in range(4)]
    return torch.stack(kernels)


class ChosenKernel(nn.Module):
    """The best of some kernels for each patch, or none of them.

    Args:
        kernels: To choose from, besides doing nothing.
    """

    kernels: Tensor

    def __init__(self, kernels: Float[Tensor, "q k k"]) -> None:
        super().__init__()
        nothing = torch.zeros_like(kernels[:1])
        nothing[:, kernels.shape[1] // 2, kernels.shape[2] // 2] = 1
        self.register_buffer("kernels", torch.cat([kernels, nothing]), persistent=False)

    def forward(
        self,
        sharp: Float[Tensor, "m h w c"],
        recorded: Float[Tensor, "m h w c"],
        known: Float[Tensor, "m h w"],
    ) -> Float[Tensor, "m h w c"]:
        """Patches blurred to look like recorded ones; gradients flow through the chosen kernels.

        Args:
            sharp: As rendered.
            recorded: As they should be.
            known: 1 where something was rendered; other pixels count for nothing.
        """
        mask = known[..., None]
        with torch.no_grad():
            light = convolve_all(sharp * mask, self.kernels)
            share = convolve_all(mask, self.kernels).clamp_min(FAINT)
            apart = light / share * mask[:, None]
            chosen = self.kernels[best_match(apart, recorded * mask)]
        share = convolve(mask, chosen).clamp_min(FAINT)
        return convolve(sharp * mask, chosen) / share


class LearnedKernel(nn.Module):
    """A kernel for each patch, by a network that sees the rendered and the recorded patch.

    Args:
        side: Pixels along the edge of a patch.
        seed: Of the run.
        size: Of the kernels, odd.
        edge: What happens at the edges of patches.
        still_share: Whether the network also says how much of the pixel stays where it is:
            `learned`, as published, or `none`.
    """

    def __init__(
        self,
        side: int,
        *,
        seed: int,
        size: int = 9,
        edge: Edge = "keep",
        still_share: Literal["learned", "none"] = "learned",
    ) -> None:
        super().__init__()
        self.size, self.edge, self.still_share = size, edge, still_share
        width = 2 * side * side
        made = generator(seed, 0, "patch kernel")
        sizes = [width, 128, 128, 128, size * size + 1]
        self.network = LeakyLayers(sizes, generator=made, ends="linear")

    def kernels(
        self, sharp: Float[Tensor, "m h w c"], recorded: Float[Tensor, "m h w c"]
    ) -> Float[Tensor, "m k k"]:
        """The kernel of each patch; it sums to one."""
        grey = torch.cat([recorded.mean(-1).flatten(1), sharp.mean(-1).flatten(1)], -1)
        said = self.network(grey).sigmoid()
        moved = said[:, :-1] / said[:, :-1].sum(-1, keepdim=True)
        if self.still_share == "none":
            return moved.view(-1, self.size, self.size)
        centre = torch.zeros_like(moved[:1])
        centre[:, self.size**2 // 2] = 1
        both = said[:, -1:] * moved + (1 - said[:, -1:]) * centre
        return (both / both.sum(-1, keepdim=True)).view(-1, self.size, self.size)

    def forward(
        self,
        sharp: Float[Tensor, "m h w c"],
        recorded: Float[Tensor, "m h w c"],
        known: Float[Tensor, "m h w"],
    ) -> Float[Tensor, "m h w c"]:
        """Patches blurred to look like recorded ones; see `ChosenKernel`."""
        mask = known[..., None]
        kernels = self.kernels(sharp * mask, recorded)
        light, share = convolve(sharp * mask, kernels), convolve(mask, kernels)
        if self.edge == "keep":
            return light + (1 - share) * sharp
        share = share.clamp_min(FAINT)
        return light / (share if self.edge == "divide" else share.detach())


def _stroke(size: int, ahead: int, behind: int, degrees: int) -> Float[Tensor, "k k"]:
    """A line from so many pixels ahead of the centre to so many behind, turned to the left."""
    middle = size // 2
    line = torch.zeros(size, size, dtype=torch.float64)
    line[middle - ahead : middle + behind + 1, middle] = 1
    turned = _turned(line, degrees)
    return (turned / turned.sum()).float()


def _turned(image: Float[Tensor, "k k"], degrees: int) -> Float[Tensor, "k k"]:
    """An image turned counter-clockwise about its middle, bilinear, zero outside."""
    size = len(image)
    middle = size // 2
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    y, x = torch.meshgrid(
        torch.arange(size, dtype=torch.float64),
        torch.arange(size, dtype=torch.float64),
        indexing="ij",
    )
    column = _between(cosine * x, -sine * y + middle * (1 - cosine + sine))
    row = _between(sine * x, cosine * y + middle * (1 - sine - cosine))
    left, top = column.floor(), row.floor()
    across, down = column - left, row - top
    padded = torch.nn.functional.pad(image, (size, size, size, size))
    i, j = top.long() + size, left.long() + size
    upper = padded[i, j] * (1 - across) + padded[i, j + 1] * across
    lower = padded[i + 1, j] * (1 - across) + padded[i + 1, j + 1] * across
    return upper * (1 - down) + lower * down


def _between(one: Float[Tensor, "k k"], other: Float[Tensor, "k k"]) -> Float[Tensor, "k k"]:
    """The sum of two coordinates, rounded."""
    fine = (FINE * one).round() + (FINE * other).round()
    return ((fine + FINE / PARTS / 2) / (FINE / PARTS)).floor() / PARTS
