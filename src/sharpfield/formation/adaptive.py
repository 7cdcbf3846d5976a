"""Adaptive weight proposal: weights of a pixel's rays, from the features along them.

The rigid kernel gives all pixels of an image the same weights. This network reads the features of
the scene along each ray of a pixel and proposes weights for that pixel only, with which the same
light is mixed a second time.

Vocabulary: k rays of a pixel, s samples on each, f features of a sample. A *local* feature belongs
to a sample, the *global* one to a ray. *Inter* summarises each ray over its samples, *intra* each
sample over the rays.

Memory: the features `[b, k, s, f]` are the largest tensor of a training step. They are read in
place, a few pixels at a time, and other tensors of their length are recomputed in the backward pass
instead of being kept.

Sources: DP-NeRF (CVPR 2023), section 3.3 (adaptive weight proposal), with the curve aggregation of
CurveNet (ICCV 2021); sizes from Ev-DeblurNeRF (CVPR 2024).
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint  # pyright: ignore[reportUnknownVariableType]

from sharpfield.core.rays import Samples
from sharpfield.ops.dense import Dense, linear
from sharpfield.ops.encoding import frequencies, frequencies_width

Integration = Literal["samples", "channels"]
Norm = Literal["layer", "batch"]

EMBEDDED, LOCAL, SUMMARY = 64, 32, 16
"""Widths: of an embedded sample, of local and global features, of the summaries compared."""

OCTAVES = 2
"""Of the encoding of the ray's direction."""

CPU_CHUNK, CHUNK = 1 << 14, 1 << 19
"""Samples embedded at once: few enough for a CPU's cache, or enough to fill a GPU."""


class AdaptiveWeights(nn.Module):
    """Weights for each pixel's rays from features along them.

    Args:
        rays: Rays of a pixel, the origin among them.
        features: Width of a sample's features.
        code: Width of an image's code.
        integration: How samples are gathered along a ray. `samples` is volume rendering with each
            embedded channel as a density. `channels` is what the released code of DP-NeRF and
            Ev-DeblurNeRF computes: the transmittance runs along the channels of the previous
            sample instead of along the samples.
        norm: `batch` as published, which couples the pixels of a batch; `layer` does not. Batch
            statistics are always those of the batch: the network is only used in training.
        generator: Where the first parameters come from.
    """

    def __init__(
        self,
        rays: int,
        *,
        features: int = 128,
        code: int = 32,
        integration: Integration = "channels",
        norm: Norm = "batch",
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.integration: Integration = integration
        self.embed = Dense([features] + 4 * [EMBEDDED], generator=generator)
        self.localise = Dense([EMBEDDED, LOCAL], generator=generator)
        self.attend = Dense([LOCAL, 1], generator=generator, bias=False)
        of_ray = EMBEDDED + code + frequencies_width(3, OCTAVES)
        self.globalise = Dense([of_ray, LOCAL, LOCAL], generator=generator)
        self.aggregate = _Aggregation(norm, generator)
        self.head = linear(LOCAL, rays, generator=generator)

    def forward(self, samples: Samples, code: Float[Tensor, "b l"]) -> Float[Tensor, "b k"]:
        """Weights that sum to one for each pixel.

        Args:
            samples: The fine samples along the rays `[b, k]`. Only the direction of each pixel's
                first ray is read as such; of all of them the length scales the depths.
            code: Of each pixel's image.
        """
        ray, inter, intra = self._summaries(samples)
        unit = nn.functional.normalize(samples.direction[:, 0], dim=-1)
        shared = torch.cat([code, frequencies(unit, OCTAVES)], -1)[:, None]
        whole = torch.cat([ray, shared.expand(-1, ray.shape[1], -1)], -1)
        whole = self.aggregate(self.globalise(whole).relu(), inter, intra)  # [b, k, 32]
        weight = self.head(whole.mean(1)).sigmoid()
        return weight / weight.sum(-1, keepdim=True)

    def _summaries(
        self, samples: Samples
    ) -> tuple[Float[Tensor, "b k e"], Float[Tensor, "b k l"], Float[Tensor, "b s l"]]:
        """All that reads single samples: each ray integrated, and the two summaries."""
        length = samples.direction.square().sum(-1, keepdim=True).sqrt()
        gap = samples.depth.diff(dim=-1) * length
        gap = nn.functional.pad(gap, (0, 1))  # the last sample has no weight
        at_once = CPU_CHUNK if gap.is_cpu else CHUNK
        pixels = max(at_once // gap.shape[1:].numel(), 1)
        pieces = zip(torch.split(samples.feature, pixels), torch.split(gap, pixels), strict=True)
        parts: list[tuple[Tensor, Tensor, Tensor]] = [
            checkpoint(self._along, *piece, use_reentrant=False, preserve_rng_state=False)
            for piece in pieces
        ]
        ray, inter, intra = (torch.cat(column) for column in zip(*parts, strict=True))
        return ray, inter, intra

    def _along(
        self, features: Float[Tensor, "b k s f"], gap: Float[Tensor, "b k s"]
    ) -> tuple[Float[Tensor, "b k e"], Float[Tensor, "b k l"], Float[Tensor, "b s l"]]:
        embedded = self.embed(features).relu()  # [b, k, s, 64]
        ray = _integrated(embedded.to(gap.dtype), gap, self.integration)
        local = self.localise(embedded)  # [b, k, s, 32]
        attention = self.attend(local).to(gap.dtype)  # [b, k, s, 1]
        inter = (attention.softmax(2) * local).sum(2)
        intra = (attention.softmax(1) * local).sum(1)
        return ray, inter, intra


class _Aggregation(nn.Module):
    """Each ray looks up both summaries, and adds what it finds to its own feature."""

    def __init__(self, norm: Norm, generator: torch.Generator) -> None:
        super().__init__()

        def plain(inputs: int, outputs: int) -> nn.Linear:
            return linear(inputs, outputs, generator=generator, bias=False)

        self.query = plain(LOCAL, SUMMARY)
        self.inter_key, self.intra_key = plain(LOCAL, SUMMARY), plain(LOCAL, SUMMARY)
        self.inter_value, self.intra_value = plain(SUMMARY, SUMMARY), plain(SUMMARY, SUMMARY)
        self.join = plain(2 * SUMMARY, LOCAL)
        self.norm = (
            nn.BatchNorm1d(LOCAL, track_running_stats=False)
            if norm == "batch"
            else nn.LayerNorm(LOCAL)
        )

    def forward(
        self,
        whole: Float[Tensor, "b k l"],
        inter: Float[Tensor, "b k l"],
        intra: Float[Tensor, "b s l"],
    ) -> Float[Tensor, "b k l"]:
        query = self.query(whole)
        found = torch.cat(
            [
                _look_up(query, self.inter_key(inter), self.inter_value),
                _look_up(query, self.intra_key(intra), self.intra_value),
            ],
            -1,
        )
        change = self.norm(self.join(found).flatten(0, 1)).view_as(whole)
        return nn.functional.leaky_relu(whole + change, 0.2)


def _look_up(
    query: Float[Tensor, "b k d"], key: Float[Tensor, "b n d"], value: nn.Module
) -> Float[Tensor, "b k d"]:
    return (query @ key.transpose(1, 2)).softmax(-1) @ value(key)


def _integrated(
    density: Float[Tensor, "b k s e"], gap: Float[Tensor, "b k s"], integration: Integration
) -> Float[Tensor, "b k e"]:
    """Volume rendering of each channel with itself as density: sum_s T_s (1 - e^(-h_s d_s)) h_s.

    With `channels` T_s is the released transmittance: along the previous sample's channels, up to
    e.
    """
    thick = density * gap[..., None]
    if integration == "samples":
        before = thick.cumsum(2) - thick
    else:
        before = nn.functional.pad(thick[:, :, :-1].cumsum(3), (0, 0, 1, 0))
    return ((-before).exp() * -torch.expm1(-thick) * density).sum(2)
