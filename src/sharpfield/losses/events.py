"""How far predicted changes of log intensity are from what events report.

Everything is in natural log. `predicted` comes from `formation.LogContrast`, `measured` from
`EventPairs.measured` with the contrast thresholds.

How far predicted changes of log intensity are from events counted in windows of time.

Everything is in natural log. `measured` is the signed counts times their thresholds.

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
    """Mean square of how far the change of silent pixels goes beyond a threshold.

    A pixel that reports nothing between two instants has not changed by a whole threshold: that
    is all it says, so smaller changes cost nothing.

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
    """Mean squared difference of both divided by a scale of its own.

    With scales that differ, what is learned is log intensity times `scale / measured_scale`.
    """
    return (predicted / scale - measured / measured_scale).square().mean()


def dead_zone_error(
    predicted: Float[Tensor, "b"], measured: Float[Tensor, "b"], threshold: float
) -> Float[Tensor, ""]:
    """Mean squared distance from the middle of a zone one threshold wide; nothing inside it.

    The zone reaches from the measured change to one threshold further from zero, to brighter where
    nothing was measured. There the distance is that from zero, as published: a small change to
    darker costs, though it would not have made an event.
    """
    away = torch.where(measured < 0, -1.0, 1.0)
    beyond = (predicted - measured) * away
    inside = (beyond >= 0) & (beyond < threshold)
    middle = torch.where(measured == 0, measured, measured + away * threshold / 2)
    return ((predicted - middle).square() * ~inside).mean()


def exact_error(
    predicted: Float[Tensor, "b"], measured: Float[Tensor, "b"], threshold: Float[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Mean difference in thresholds where nothing is left over: squared up to one, then linear."""
    return _robust((predicted - measured).abs() / threshold).mean()


def counted_error(
    predicted: Float[Tensor, "b"],
    measured: Float[Tensor, "b"],
    threshold: Float[Tensor, "b"],
    *,
    pull: float = 0.0,
) -> Float[Tensor, ""]:
    """The same where less than one threshold is left over at either end of the windows.

    n more events to brighter than to darker say that the change is between n - 1 and n + 1
    thresholds. Inside, only `pull` of the difference counts.
    """
    off = (predicted - measured).abs() / threshold
    return (_robust((off - 1).clamp_min(0)) + pull * _robust(off)).mean()


def _robust(off: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """Huber's, times two."""
    return torch.where(off < 1, off.square(), 2 * off - 1)
