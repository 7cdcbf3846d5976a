"""How far predicted changes of log intensity are from the events that were measured.

Everything is in natural log: `predicted` is the change that a scene makes (`formation.events`),
`measured` the signed counts of events times their contrast thresholds (`EventPairs.measured`), from
event to event or in windows of time. Errors of whole views are in units of events, as their number
is what was measured, and what is rounded; their windows go from one instant of a batch to the next.

Source: EvDNeRF (WACV 2024) for the normalised error and the dead zone; Robust e-NeRF (ICCV 2023)
for errors in units of the threshold.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sharpfield.core.errors import ShapeError
from sharpfield.core.measurements import EventPairs
from sharpfield.events.threshold import Thresholds

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
    predicted: Float[Tensor, "b 1"], negative: Float[Tensor, "b"], positive: Float[Tensor, "b"]
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


BLOCK = 8
"""Side of a block of pixels, far larger than soft edges and errors of position."""

TINY = 1e-12
"""Least mean square change of log light that is divided by."""


def count_error(
    change: Float[Tensor, "m q h w c"], events: EventPairs, thresholds: Thresholds
) -> Float[Tensor, ""]:
    """Mean squared error of the number of events, beyond their rounding.

    No gradient goes to the thresholds: structure so fine that only events show it agrees with any
    threshold.

    Args:
        change: Predicted change of log light over each window.
        events: Counted in these windows, with their `slack`.
        thresholds: Contrast thresholds of the event camera.
    """
    seen = events.reshape(-1)
    negative, positive = (threshold.detach() for threshold in thresholds(seen))
    change = change.reshape(-1)
    threshold = torch.where(change > 0, positive, negative)
    off = (change - seen.measured(negative, positive)).abs() / threshold
    return torch.relu(off - (0.0 if seen.slack is None else seen.slack)).square().mean()


def threshold_error(
    change: Float[Tensor, "m q h w c"], events: EventPairs, thresholds: Thresholds
) -> Float[Tensor, ""]:
    """Mean squared error of the number of events over all windows of a batch together.

    The thresholds learn from this, and the scene does not. They do not follow the gradient of the
    error, which would make them too small: a scene that is a little soft changes less than the
    light did, and one that is a little displaced changes at other pixels. Over blocks of pixels
    neither matters. So the predicted mean change of a block is compared with the part of it that
    the events of its pixels leave unexplained, and each threshold is pulled up by that part where
    the predicted change has its sign. (In regression with errors in both variables, the mean over
    a block is an *instrument* for the counts.) Over a long time, rounding of the counts and light
    that came back matter least.

    Args:
        change: Predicted change of log light over each window.
        events: Counted in these windows.
        thresholds: Contrast thresholds of the event camera.
    """
    whole = replace(
        events[:, 0], negative=events.negative.sum(1), positive=events.positive.sum(1), slack=None
    ).reshape(-1)
    negative, positive = thresholds(whole)
    total = change.detach().sum(1)  # [m, h, w, c]
    predicted = _block_means(total).reshape(-1)
    missing = total.reshape(-1) - whole.measured(negative.detach(), positive.detach())
    share = predicted * missing / predicted.square().mean().clamp_min(TINY)
    pull = -(share * torch.where(predicted > 0, positive, negative).log()).mean()
    error = (missing / (negative * positive).detach().sqrt()).square().mean()
    return error + pull - pull.detach()


def _block_means(image: Float[Tensor, "m h w c"]) -> Float[Tensor, "m h w c"]:
    """Means over blocks of pixels, at each of their pixels."""
    height, width = image.shape[1:3]
    each = image.movedim(-1, 1)
    means = torch.nn.functional.avg_pool2d(each, BLOCK, ceil_mode=True, count_include_pad=False)
    wide = means.repeat_interleave(BLOCK, -1).repeat_interleave(BLOCK, -2)
    return wide[..., :height, :width].movedim(1, -1)
