"""What pictures of a scene show at places in it, and how it joins what the places know themselves.

Every *source*, a picture with a known pose, is turned into *levels*: the picture itself, and three
maps of features at a half, a quarter and an eighth of its size. A place is looked up in each; what
several sources say of it is *merged* by learned weights, and a residual network *mixes* the result
into the place's own feature.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.1; sizes from the released code.
"""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.seed import generator
from sharpfield.ops.leaky import GAIN, LeakyLayers, leaky, xavier

MAPS = (6, 12, 24)
"""Channels of the three maps."""

MERGED = 1e-6
"""Added to the sum of weights, so that places no source shows get zero."""

Fetch = Literal["nearest", "bilinear"]
"""Read the pixel that holds a place, as published, or between pixels."""


class FeatureExtractor(nn.Module):
    """Two small convolutions for each map, the first of which halves the size.

    Args:
        colours: Channels of a picture, 1 or 3.
        seed: Of the run.
    """

    def __init__(self, colours: int, *, seed: int) -> None:
        super().__init__()
        made = generator(seed, 0, "feature extractor")
        self.stages = nn.ModuleList()
        inputs = colours
        for outputs in MAPS:
            halving = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1, device="meta")
            keeping = nn.Conv2d(outputs, outputs, 3, padding=1, device="meta")
            stage = nn.ModuleList([one.to_empty(device="cpu") for one in (halving, keeping)])
            for one in stage:
                assert isinstance(one, nn.Conv2d)
                xavier(one, GAIN, made)
            self.stages.append(stage)
            inputs = outputs

    def forward(self, pictures: Float[Tensor, "n h w c"]) -> list[Float[Tensor, "n _h _w _f"]]:
        """The pictures and their three maps, channels last."""
        levels = [pictures]
        image = pictures.movedim(-1, 1)
        for stage in self.stages:
            assert isinstance(stage, nn.ModuleList)
            for one in stage:
                image = leaky(one(image))
            levels.append(image.movedim(1, -1).contiguous())
        return levels


def look_up(
    levels: Sequence[Float[Tensor, "n _h _w _f"]],
    source: Int64[Tensor, "*b"],
    xy: Float[Tensor, "*b 2"],
    *,
    fetch: Fetch = "nearest",
) -> Float[Tensor, "*b f"]:
    """What all levels of some sources hold at pixels, side by side.

    Equal to enlarging every map to the size of the picture (bilinearly) and reading it there, but
    the enlarged maps never exist.

    Args:
        levels: Of all sources.
        source: Which of them each pixel belongs to.
        xy: In pixels, centres at +0.5; clamped to the picture.
        fetch: Whether to read whole pixels.
    """
    height, width = levels[0].shape[1:3]
    flat = xy.reshape(-1, 2)
    if fetch == "nearest":
        flat = flat.floor() + 0.5
    found = [_bilinear(level, source.flatten(), flat, (height, width)) for level in levels]
    return torch.cat(found, -1).view(*source.shape, -1)


class Merging(nn.Module):
    """How much each source counts at a place.

    Args:
        looked: Width of what a source shows.
        feature: Width of a place's own feature.
        width: Of the hidden layers.
        seed: Of the run.
    """

    def __init__(self, looked: int, feature: int, *, seed: int, width: int = 64) -> None:
        super().__init__()
        made = generator(seed, 0, "merging")
        sizes = [looked + feature + 3, width, width, width, 1]
        self.network = LeakyLayers(sizes, generator=made, ends="linear")

    def forward(
        self,
        shown: Float[Tensor, "n v f"],
        feature: Float[Tensor, "n r"],
        change: Float[Tensor, "n v 3"],
        visible: Float[Tensor, "n v"],
    ) -> tuple[Float[Tensor, "n f"], Float[Tensor, "n v"]]:
        """What the sources say together, and the weights they were given.

        Args:
            shown: By each source.
            feature: Of each place.
            change: Unit direction from the source to the place, minus that of the ray.
            visible: Factor on the weights; 0 outside of a picture.
        """
        own = self.network.first(feature, skipped=shown.shape[-1])  # once for all sources
        both = self.network.first(shown) + own[:, None]
        both = both + self.network.first(change, skipped=shown.shape[-1] + feature.shape[-1])
        raw = self.network.rest(leaky(both))[..., 0]
        weight = raw.float().sigmoid() * visible
        total = weight.sum(-1, keepdim=True) + MERGED
        return ((weight / total)[:, None] @ shown)[:, 0], weight


class Mixing(nn.Module):
    """Adds to the first features of a place what its own and the merged ones make together.

    Args:
        looked: Width of what sources show; so many features change.
        seed: Of the run.
    """

    def __init__(self, looked: int, *, seed: int) -> None:
        super().__init__()
        self.looked = looked
        made = generator(seed, 0, "mixing")
        sizes = [2 * looked, looked, looked, looked]
        self.network = LeakyLayers(sizes, generator=made, ends="linear")

    def forward(
        self, feature: Float[Tensor, "n r"], merged: Float[Tensor, "n f"]
    ) -> Float[Tensor, "n r"]:
        """The feature with what pictures know of it."""
        first, others = feature[:, : self.looked], feature[:, self.looked :]
        return torch.cat([first + self.network(first, merged.to(first.dtype)), others], -1)


def _bilinear(
    level: Float[Tensor, "n h w f"],
    source: Int64[Tensor, "m"],
    xy: Float[Tensor, "m 2"],
    size: tuple[int, int],
) -> Float[Tensor, "m f"]:
    """One level at pixels of the picture, whose height and width are `size`."""
    height, width = level.shape[1:3]
    rows = level.reshape(-1, level.shape[-1])
    if (height, width) == size:
        place = xy - 0.5
    else:
        place = xy * xy.new_tensor([width / size[1], height / size[0]]) - 0.5
    place = torch.minimum(place.clamp_min(0), place.new_tensor([width - 1, height - 1]))
    low = place.floor()
    x, y = (place - low).unbind(-1)
    column, row = low.long().unbind(-1)
    right, below = (column + 1).clamp_max(width - 1), (row + 1).clamp_max(height - 1)
    base = source * height
    taps = torch.stack(
        [
            (base + row) * width + column,
            (base + row) * width + right,
            (base + below) * width + column,
            (base + below) * width + right,
        ],
        -1,
    )
    weight = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
    read = rows.index_select(0, taps.flatten()).view(*taps.shape, -1)
    return (weight[:, None] @ read)[:, 0]
