"""How far the change of log light of whole views is from the events counted in windows.

A *window* is the time from one instant of a batch to the next. Errors are in units of events, as
their number is what was measured, and what is rounded.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.measurements import EventPairs
from sharpfield.events.threshold import Thresholds

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
