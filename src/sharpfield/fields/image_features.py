"""Image-based features: features of posed images, projected to positions and merged with their own.

Every *source*, an image with a known pose, is encoded to *levels*: the image itself, and three
feature maps at a half, a quarter and an eighth of its size. A position is projected to each source
and sampled there; the features of several sources are *merged* with learned weights, and a residual
network *mixes* the result into the position's own feature.

Source: Hybrid Neural Rendering (CVPR 2023), section 3.1; sizes from the released code.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.seed import generator
from sharpfield.ops.dense import GAIN, LeakyLayers, leaky, xavier

MAPS = (6, 12, 24)
"""Channels of the three maps."""

MERGED = 1e-6
"""Added to the sum of weights, so that positions outside all sources get zero."""


class FeatureExtractor(nn.Module):
    """Two small convolutions for each map, the first of which halves the size.

    Args:
        colours: Channels of a image, 1 or 3.
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

    def forward(self, images: Float[Tensor, "n h w c"]) -> list[Float[Tensor, "n _h _w _f"]]:
        """The images and their three maps, channels last."""
        levels = [images]
        image = images.movedim(-1, 1)
        for stage in self.stages:
            assert isinstance(stage, nn.ModuleList)
            for one in stage:
                image = leaky(one(image))
            levels.append(image.movedim(1, -1).contiguous())
        return levels


class Merging(nn.Module):
    """Learned weights of sources at positions.

    Args:
        looked: Width of the features of a source.
        feature: Width of a position's own feature.
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
        """Merged features of the sources, and the weights of the sources.

        Args:
            shown: Features of each source.
            feature: Of each position.
            change: Unit direction from the source to the position, minus that of the ray.
            visible: Factor on the weights; 0 outside of an image.
        """
        own = self.network.first(feature, skipped=shown.shape[-1])  # once for all sources
        both = self.network.first(shown) + own[:, None]
        both = both + self.network.first(change, skipped=shown.shape[-1] + feature.shape[-1])
        raw = self.network.rest(leaky(both))[..., 0]
        weight = raw.float().sigmoid() * visible
        total = weight.sum(-1, keepdim=True) + MERGED
        return ((weight / total)[:, None] @ shown)[:, 0], weight


class Mixing(nn.Module):
    """Residual network from own and merged features to a change of the first own features.

    Args:
        looked: Width of the features of sources, and of the part that changes.
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
        """The feature after the residual update."""
        first, others = feature[:, : self.looked], feature[:, self.looked :]
        return torch.cat([first + self.network(first, merged.to(first.dtype)), others], -1)
