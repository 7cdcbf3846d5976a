"""Blur kernels of small patches: the best of a fixed set, or one predicted for each patch.

A rendered patch is sharp, a recorded one may be blurred. Before they are compared, the rendered one
is blurred by the kernel that makes it most similar to the recorded one. One kernel is the identity,
so that sharp patches stay sharp. Kernels do not depend on cameras or depth.

Patches are `[m, h, w, c]`; kernels `[m, k, k]` or `[q, k, k]` with an odd k, centred on the pixel
that they make. Pixels outside a patch are zero. Kernels are applied by correlation, without
flipping them; sets of kernels that are closed under half turns are not affected.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.2; sizes and rules from the released code.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.seed import generator
from sharpfield.ops.dense import LeakyLayers

PARTS, FINE = 32, 1024
"""Subpixel positions are rounded to 1/PARTS, from sums rounded to 1/FINE, as OpenCV used to do when
rotating images."""

FAINT = 1e-6
"""Smallest sum of a kernel over known pixels that a pixel is divided by."""

Kind = Literal["outward", "through", "both"]
"""Line kernels that begin at the pixel (8 directions), are centred on it (4), or both."""

Edge = Literal["keep", "divide", "still"]
"""What replaces the part of a learned kernel outside the patch: the pixel itself; a larger weight
of the rest; or the latter without a gradient through that weight."""


def motion_kernels(
    size: int = 9, distances: tuple[int, ...] = (1, 2, 4), *, kind: Kind = "both"
) -> Float[Tensor, "q k k"]:
    """Straight line kernels in all directions, each summing to one.

    Args:
        size: Pixels a side; odd.
        distances: Length from the pixel, in pixels.
        kind: See `Kind`.
    """
    kernels: list[Tensor] = []
    if kind in ("outward", "both"):
        kernels += [_stroke(size, m, 0, 45 * turn) for m in distances for turn in range(8)]
    if kind in ("through", "both"):
        kernels += [_stroke(size, m, m, 45 * turn) for m in distances for turn in range(4)]
    return torch.stack(kernels)


class ChosenKernel(nn.Module):
    """The best of some kernels for each patch, or the identity.

    Args:
        kernels: To choose from, besides the identity.
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
        """Patches blurred to match recorded ones; gradients flow through the chosen kernels.

        Args:
            sharp: As rendered.
            recorded: The target.
            known: 1 where something was rendered; other pixels do not count.
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
    """A kernel for each patch, predicted from the rendered and the recorded patch.

    Args:
        side: Pixels along the edge of a patch.
        seed: Of the run.
        size: Of the kernels, odd.
        edge: What happens at the edges of patches.
        still_share: Whether the network also predicts the weight of the identity kernel:
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
        out = self.network(grey).sigmoid()  # [m, k k + 1]
        moved = out[:, :-1] / out[:, :-1].sum(-1, keepdim=True)
        if self.still_share == "none":
            return moved.view(-1, self.size, self.size)
        centre = torch.zeros_like(moved[:1])
        centre[:, self.size**2 // 2] = 1
        both = out[:, -1:] * moved + (1 - out[:, -1:]) * centre
        return (both / both.sum(-1, keepdim=True)).view(-1, self.size, self.size)

    def forward(
        self,
        sharp: Float[Tensor, "m h w c"],
        recorded: Float[Tensor, "m h w c"],
        known: Float[Tensor, "m h w"],
    ) -> Float[Tensor, "m h w c"]:
        """Patches blurred to match recorded ones; see `ChosenKernel`."""
        mask = known[..., None]
        kernels = self.kernels(sharp * mask, recorded)
        light, share = convolve(sharp * mask, kernels), convolve(mask, kernels)
        if self.edge == "keep":
            return light + (1 - share) * sharp
        share = share.clamp_min(FAINT)
        return light / (share if self.edge == "divide" else share.detach())


def _stroke(size: int, ahead: int, behind: int, degrees: int) -> Float[Tensor, "k k"]:
    """A line from `ahead` pixels above the centre to `behind` below it, rotated to the left."""
    middle = size // 2
    line = torch.zeros(size, size, dtype=torch.float64)
    line[middle - ahead : middle + behind + 1, middle] = 1
    turned = _turned(line, degrees)
    return (turned / turned.sum()).float()


def _turned(image: Float[Tensor, "k k"], degrees: int) -> Float[Tensor, "k k"]:
    """An image rotated counter-clockwise about its middle, bilinear, zero outside."""
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


def unfold(patches: Float[Tensor, "m h w c"], size: int) -> Float[Tensor, "m h w c s"]:
    """The `size` x `size` pixels around each pixel, row after row; s = size^2.

    Args:
        patches: Any.
        size: Odd.
    """
    m, h, w, c = patches.shape
    image = patches.movedim(-1, 1).reshape(m * c, 1, h, w)
    around = torch.nn.functional.unfold(image, size, padding=size // 2)  # [m c, s, h w]
    return around.view(m, c, size * size, h, w).permute(0, 3, 4, 1, 2)


def convolve(
    patches: Float[Tensor, "m h w c"], kernels: Float[Tensor, "m k k"]
) -> Float[Tensor, "m h w c"]:
    """One kernel on each patch."""
    around = unfold(patches, kernels.shape[-1])
    return torch.einsum("mhwcs,ms->mhwc", around, kernels.flatten(1))


def convolve_all(
    patches: Float[Tensor, "m h w c"], kernels: Float[Tensor, "q k k"]
) -> Float[Tensor, "m q h w c"]:
    """Every kernel on every patch."""
    around = unfold(patches, kernels.shape[-1])
    return torch.einsum("mhwcs,qs->mqhwc", around, kernels.flatten(1))


def best_match(
    candidates: Float[Tensor, "m q h w c"], wanted: Float[Tensor, "m h w c"]
) -> Int64[Tensor, "m"]:
    """The candidate of each patch with the smallest sum of absolute differences; the first of ties.

    Source: Hybrid Neural Rendering (CVPR 2023), section 3.2.
    """
    return (candidates - wanted[:, None]).abs().flatten(2).sum(-1).argmin(-1)
