"""How far predicted changes of log intensity are from the events that were measured.

Everything is in natural log: `predicted` is the change that a scene makes (`formation.events`),
`measured` the signed counts of events times their contrast thresholds (`EventPairs.measured`), from
event to event or in windows of time.

Source: EvDNeRF (WACV 2024) for the normalised error and the dead zone; Robust e-NeRF (ICCV 2023)
for errors in units of the threshold.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sharpfield.core.errors import ShapeError

BAYER_WEIGHTS = (0.4, 0.2, 0.4)
"""Red, green, blue: a Bayer sensor has twice as many green pixels."""


def contrast_error(
    predicted: Float[Tensor, "b 1"],
    measured: Float[Tensor, "b"],
    *,
    channel: Int[Tensor, "b"] | None = None,
    weights: tuple[float, float, float] | None = None,
) -> Float[Tensor, ""]:
    """Weighted mean squared difference of predicted and measured change: sum w d^2 / sum w.

    Args:
        predicted: Change of log intensity.
        measured: Signed counts times their thresholds.
        channel: The colour each pixel's filter passes: 0 red, 1 green, 2 blue.
        weights: How much a pair of each colour counts, e.g. `BAYER_WEIGHTS`; needs `channel`. None
            counts all alike.

    Raises:
        ShapeError: There are weights and no channels.

    Source: Ev-DeblurNeRF (CVPR 2024), event term of the loss.
    """
    squared = (predicted[:, 0] - measured).square()
    if weights is None:
        return squared.mean()
    if channel is None:
        raise ShapeError(
            "colour weights need the colour of each pair",
            got="channel=None",
            do="leave `weights` out for a mono sensor",
        )
    weight = squared.new_tensor(weights)[channel]
    return (weight * squared).sum() / weight.sum()


def silence_error(
    predicted: Float[Tensor, "b 1"],
    negative: Float[Tensor, "b"],
    positive: Float[Tensor, "b"],
) -> Float[Tensor, ""]:
    """Mean square of the excess over a threshold of the change of pixels without events.

    A pixel that reports nothing between two instants has not changed by a whole threshold; smaller
    changes cost nothing.

    Args:
        predicted: Change of log intensity between two instants without events.
        negative: Threshold to darker, positive.
        positive: Threshold to brighter.
    """
    change = predicted[:, 0]
    beyond = torch.relu(change - positive) + torch.relu(-change - negative)
    return beyond.square().mean()


def scaled_error(
    predicted: Float[Tensor, "b"],
    measured: Float[Tensor, "b"],
    *,
    scale: float,
    measured_scale: float,
) -> Float[Tensor, ""]:
    """Mean squared difference, each side divided by a scale of its own.

    With different scales the scene learns log intensity times `scale / measured_scale`.
    """
    return (predicted / scale - measured / measured_scale).square().mean()


def dead_zone_error(
    predicted: Float[Tensor, "b"], measured: Float[Tensor, "b"], threshold: float
) -> Float[Tensor, ""]:
    """Mean squared distance from the middle of a dead zone one threshold wide; zero inside it.

    The zone reaches from the measured change to one threshold further from zero, or to brighter
    where nothing was measured; in that case the distance is taken from zero, as published, so that
    a small change to darker costs although it would not have caused an event.
    """
    away = torch.where(measured < 0, -1.0, 1.0)
    beyond = (predicted - measured) * away
    inside = (beyond >= 0) & (beyond < threshold)
    middle = torch.where(measured == 0, measured, measured + away * threshold / 2)
    return ((predicted - middle).square() * ~inside).mean()


def exact_error(
    predicted: Float[Tensor, "b"], measured: Float[Tensor, "b"], threshold: Float[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Mean robust difference in thresholds, for exact measurements: squared to 1, then linear."""
    return _robust((predicted - measured).abs() / threshold).mean()


def counted_error(
    predicted: Float[Tensor, "b"],
    measured: Float[Tensor, "b"],
    threshold: Float[Tensor, "b"],
    *,
    pull: float = 0.0,
) -> Float[Tensor, ""]:
    """The same for whole counts, whose windows may begin and end between two events.

    A net count of n events means a change between n - 1 and n + 1 thresholds. Within that range
    the difference is weighted by `pull` only.
    """
    off = (predicted - measured).abs() / threshold
    return (_robust((off - 1).clamp_min(0)) + pull * _robust(off)).mean()


def _robust(off: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """Twice the Huber loss with delta 1."""
    return torch.where(off < 1, off.square(), 2 * off - 1)
