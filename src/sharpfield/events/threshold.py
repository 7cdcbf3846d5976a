"""Contrast thresholds: the change of log intensity that makes one event, for each sign.

A threshold object is called with event pairs and returns the two thresholds at each of them, for
`EventPairs.measured`:

    change = pairs.measured(*thresholds(pairs))

Both are positive, in units of natural log.

Estimating the contrast thresholds of a recording from its own blurred frames and events.

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
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sharpfield.core.capture import USUAL_THRESHOLD, Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import EventPairs
from sharpfield.events.double_integral import FLOOR
from sharpfield.events.log_path import LogPath


@runtime_checkable
class Thresholds(Protocol):
    """The thresholds at event pairs."""

    def __call__(self, seen: EventPairs) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"]]:
        """The threshold to darker and the one to brighter."""
        ...


@dataclass(frozen=True)
class FixedThresholds:
    """The same two numbers for every pixel."""

    negative: float
    positive: float

    def __post_init__(self) -> None:
        _positive(self.negative, self.positive)

    def __call__(self, seen: EventPairs) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"]]:
        """The two numbers, repeated."""
        return (
            torch.full_like(seen.negative, self.negative),
            torch.full_like(seen.positive, self.positive),
        )


class LearnedThresholds(nn.Module):
    """Thresholds learned as a factor on a first guess, in log space; they stay positive.

    They cannot be learned from events alone, since any common factor can be absorbed by the scene's
    contrast. Together with frames they can; `prior` keeps them near the guess where the data do not
    determine them.

    Args:
        negative: First guess, to darker.
        positive: First guess, to brighter.
        spread: One standard deviation of the prior, in log: 0.1 is about 10 %.
        pixels: (width, height) of the sensor, to learn a further factor for each pixel. None
            learns one factor for each sign.
    """

    log_guess: Float[Tensor, "2"]

    def __init__(
        self,
        negative: float,
        positive: float,
        *,
        spread: float = 0.1,
        pixels: tuple[int, int] | None = None,
    ) -> None:
        super().__init__()
        _positive(negative, positive)
        self.spread = spread
        guess = torch.tensor([math.log(negative), math.log(positive)])
        self.register_buffer("log_guess", guess, persistent=False)
        self.log_factor = nn.Parameter(torch.zeros(2))
        width, height = pixels or (0, 0)
        zeros = nn.Parameter(torch.zeros(2, height, width))
        self.log_pixel = zeros if pixels else None

    def forward(self, seen: EventPairs) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"]]:
        """The threshold to darker and the one to brighter, at each pair."""
        log = (self.log_guess + self.log_factor)[:, None].expand(2, len(seen))
        if self.log_pixel is not None:
            height, width = self.log_pixel.shape[1:]
            x, y = seen.xy.detach().floor().long().unbind(-1)
            log = log + self.log_pixel[:, y.clamp(0, height - 1), x.clamp(0, width - 1)]
        negative, positive = log.exp().to(seen.negative.dtype)
        return negative, positive

    def prior(self) -> Float[Tensor, ""]:
        """Mean squared distance from the first guess, in standard deviations; for each part."""
        total = (self.log_factor / self.spread).square().mean()
        if self.log_pixel is not None:
            total = total + (self.log_pixel / self.spread).square().mean()
        return total


def _positive(negative: float, positive: float) -> None:
    if not (negative > 0 and positive > 0):
        raise OptionError(
            "contrast thresholds must be positive",
            got=f"negative {negative}, positive {positive}",
            do="give both as sizes; the sign of an event is its polarity",
        )


def thresholds_of(
    capture: Capture, given: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Contrast thresholds, negative and positive: given, known to the capture, or the usual 0.2."""
    if given is not None:
        return given
    known = capture.known.thresholds
    return (known.negative, known.positive) if known else (USUAL_THRESHOLD, USUAL_THRESHOLD)


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
