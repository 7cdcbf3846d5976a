"""Contrast thresholds: the change of log intensity that makes one event, for each sign.

A threshold object is called with event pairs and returns the two thresholds at each of them, for
`EventPairs.measured`:

    change = pairs.measured(*thresholds(pairs))

Both are positive, in units of natural log.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import USUAL_THRESHOLD, Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import EventPairs


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
