"""Estimating the contrast thresholds of a recording from its own blurred frames and events.

Two costs measure how well a threshold explains a recording; lower is better.

*Disagreement*: the light at the middle of an exposure follows from that exposure alone, and also
from its neighbour and the events in between. Only the right threshold makes the two agree, for any
scene that moves, and without a model of what a sharp image looks like.

*Edge density*: the mean length of the gradient over its root mean square, at pixels with events.
Blur and noise both produce many small gradients, sharp edges few large ones; so the number
balances total variation against edge strength, which is how the EDI paper chooses. It needs only a
single frame. Alone it is unreliable (exaggerated edges are stronger still, and a frame with little
blur is hardly affected by the threshold), hence a weak prior towards the threshold that most
sensors are set to.

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
"""Threshold that the prior for a single frame favours, and its weight."""

COARSE = 10
"""Thresholds tried before the search around the best of them."""

SILENT = 0.02
"""Fraction of pixels without events that is enough to estimate a change of gain."""

GOLDEN = (math.sqrt(5) - 1) / 2

Cost = Callable[[FixedThresholds], float]


def disagreement(
    light: Float[Tensor, "n h w c"],
    paths: Sequence[LogPath],
    gaps: Float[Tensor, "g h w c"],
    usable: Bool[Tensor, "n h w c"],
) -> float:
    """Mean difference, in log light, between neighbouring exposures brought to the same instant.

    A change of gain or exposure time between two frames is estimated from pixels without events and
    removed first. All other pixels count.

    Args:
        light: Of the blurred frames, linear: luma, or the colours that the paths distinguish.
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
        silent, changed = distance[good & ~active], distance[good & active]
        gain = silent.median() if len(silent) >= SILENT * distance.numel() else 0.0
        total += float((changed - gain).abs().sum())
        count += len(changed)
    return total / count if count else math.inf


def edge_density(
    image: Float[Tensor, "h w 1"], where: Bool[Tensor, "h w 1"] | None = None
) -> float:
    """Mean over root mean square of the gradient's length: 1 if equal everywhere, 0 if sparse.

    Args:
        image: Display-referred values.
        where: The pixels that count; all by default.
    """
    grey = image[..., 0]
    right, down = grey[:-1, 1:] - grey[:-1, :-1], grey[1:, :-1] - grey[:-1, :-1]
    length = (right.square() + down.square()).sqrt()
    if where is not None:
        length = length[where[:-1, :-1, 0]]
    return float(length.mean() / length.square().mean().sqrt().clamp_min(1e-12))


def distance_from_usual(thresholds: FixedThresholds) -> float:
    """The prior towards the usual threshold, to be added to the edge density."""
    log = math.log(thresholds.negative / USUAL), math.log(thresholds.positive / USUAL)
    return PULL * (log[0] ** 2 + log[1] ** 2) / 2


def best_threshold(cost: Cost) -> FixedThresholds:
    """The threshold, equal for both signs, with the lowest cost."""
    common = _minimum(lambda log: cost(_both(log)), math.log(LOWEST), math.log(HIGHEST), COARSE)
    return _both(common)


def best_thresholds(cost: Cost) -> FixedThresholds:
    """A threshold for each sign: first a common one, then their ratio, then the common one again.

    Needs a cost that depends on both signs separately, such as `disagreement`.
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
    """The minimum of `cost`: the best of evenly spaced tries, then golden section around it.

    The tries keep the search out of local minima of a rough cost.
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
