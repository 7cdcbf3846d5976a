"""How far predicted changes of log intensity are from what events report.

Everything is in natural log. `predicted` comes from `formation.LogContrast`, `measured` from
`EventPairs.measured` with the contrast thresholds.
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
