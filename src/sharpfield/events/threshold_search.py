"""Finding the contrast threshold of a recording from its own blurred frames and events.

Two judges say how well a threshold explains a recording; lower is better.

*Disagreement*: each exposure by itself says what the light was at its middle, and so does its
neighbour plus the events between the two. Only the right threshold makes them agree, for any
scene that moves, without any idea of what a sharp image looks like.

*Density of edges*: the mean length of the gradient over its root mean square, where events were.
Blur and noise both fill a image with small gradients, sharp edges are few and tall; so the number
balances total variation against edge strength, which is how the EDI paper chooses. It serves
where a single frame is all there is. Alone it is easily fooled (exaggerated edges are taller
still, and a frame with little blur says next to nothing), hence a mild pull towards the threshold
most sensors are set to.

Sources: Pan et al. (CVPR 2019), section 3.3; Krishnan et al., "Blind deconvolution using a
normalized sparsity measure" (CVPR 2011).
"""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sharpfield.events.double_integral import FLOOR
from sharpfield.events.log_path import LogPath
from sharpfield.events.threshold import FixedThresholds

LOWEST, HIGHEST = 0.02, 1.2
"""Thresholds searched, in natural log. Sensors are set to 0.1 ... 0.5."""

USUAL, PULL = 0.2, 0.03
"""Threshold towards which a single frame's choice is pulled, and how strongly."""

COARSE = 10
"""Thresholds tried before the best one's neighbourhood is searched."""

SILENT = 0.02
"""Share of pixels without events that is enough to tell a change of gain."""

GOLDEN = (math.sqrt(5) - 1) / 2

Cost = Callable[[FixedThresholds], float]


def disagreement(
    light: Float[Tensor, "n h w c"],
    paths: Sequence[LogPath],
    gaps: Float[Tensor, "g h w c"],
    usable: Bool[Tensor, "n h w c"],
) -> float:
    """Mean distance, in log light, between what neighbouring exposures say of each other.

    Pixels without events tell what gain or exposure time changed between two frames; that factor
    is taken out first. All others are judged.

    Args:
        light: Of the blurred frames, linear: luma, or the colours that the paths tell apart.
        paths: Of each exposure, with its middle as the first instant.
        gaps: Change of log light from each middle to the next, g = n - 1.
        usable: Pixels that are neither too dark nor saturated.
    """
    moved = torch.stack([path.log_mean != 0 for path in paths])
    moved = moved[1:] | moved[:-1] | (gaps != 0)
    log_ratio = torch.stack([path.change[0] - path.log_mean for path in paths])
    alone = (light + FLOOR).log() + log_ratio
    apart = alone[1:] - alone[:-1] - gaps
    total, count = 0.0, 0
    for distance, active, good in zip(apart, moved, usable[1:] & usable[:-1], strict=True):
        silent, judged = distance[good & ~active], distance[good & active]
        gain = silent.median() if len(silent) >= SILENT * distance.numel() else 0.0
        total += float((judged - gain).abs().sum())
        count += len(judged)
    return total / count if count else math.inf


def edge_density(
    image: Float[Tensor, "h w 1"], where: Bool[Tensor, "h w 1"] | None = None
) -> float:
    """Mean over root mean square of the gradient's length: 1 if everywhere alike, 0 if sparse.

    Args:
        image: Display-referred, so that edges count as they are seen.
        where: The pixels to look at; all by default.
    """
    grey = image[..., 0]
    right, down = grey[:-1, 1:] - grey[:-1, :-1], grey[1:, :-1] - grey[:-1, :-1]
    length = (right.square() + down.square()).sqrt()
    if where is not None:
        length = length[where[:-1, :-1, 0]]
    return float(length.mean() / length.square().mean().sqrt().clamp_min(1e-12))


def distance_from_usual(thresholds: FixedThresholds) -> float:
    """The pull towards the usual threshold, to be added to the density of edges."""
    log = math.log(thresholds.negative / USUAL), math.log(thresholds.positive / USUAL)
    return PULL * (log[0] ** 2 + log[1] ** 2) / 2


def best_threshold(cost: Cost) -> FixedThresholds:
    """The common threshold of both signs with the lowest cost."""
    common = _minimum(lambda log: cost(_both(log)), math.log(LOWEST), math.log(HIGHEST), COARSE)
    return _both(common)


def best_thresholds(cost: Cost) -> FixedThresholds:
    """A threshold for each sign: first a common one, then their ratio, then the common one again.

    Only a cost that sees both signs apart can tell; see `disagreement`.
    """
    common = math.log(best_threshold(cost).positive)
    ratio = _minimum(
        lambda half: cost(FixedThresholds(math.exp(common - half), math.exp(common + half))),
        -0.4, 0.4, 5,
    )  # fmt: skip
    common = _minimum(
        lambda log: cost(FixedThresholds(math.exp(log - ratio), math.exp(log + ratio))),
        common - 0.2, common + 0.2, 3,
    )  # fmt: skip
    return FixedThresholds(math.exp(common - ratio), math.exp(common + ratio))


def _both(log: float) -> FixedThresholds:
    return FixedThresholds(math.exp(log), math.exp(log))


def _minimum(
    cost: Callable[[float], float], low: float, high: float, tries: int, *, within: float = 0.02
) -> float:
    """Where `cost` is lowest: the best of evenly spaced tries, then golden section around it.

    The tries keep a rough cost from catching the search in a side valley.
    """
    step = (high - low) / (tries - 1)
    tried = [low + i * step for i in range(tries)]
    best = min(tried, key=cost)
    low, high = max(low, best - step), min(high, best + step)
    inner, outer = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_inner, at_outer = cost(inner), cost(outer)
    while high - low > within:
        if at_inner <= at_outer:
            high, outer, at_outer = outer, inner, at_inner
            inner = high - GOLDEN * (high - low)
            at_inner = cost(inner)
        else:
            low, inner, at_inner = inner, outer, at_outer
            outer = low + GOLDEN * (high - low)
            at_outer = cost(outer)
    return (low + high) / 2
