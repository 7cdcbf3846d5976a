"""How far whole views are from the events counted between them.

A *window* is the time between two instants of a look that follow each other. Errors are in units of
events, as their number is what was measured, and what is rounded.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.measurements import EventPairs
from sharpfield.core.protocols import Response
from sharpfield.core.rays import Radiance
from sharpfield.events.threshold import Thresholds

BLOCK = 8
"""Side of a block of pixels, far larger than what is soft or misplaced."""

TINY = 1e-12
"""Mean square change of log light of a scene that does not move."""


def event_terms(
    light: Radiance,
    events: EventPairs,
    *,
    response: Response,
    thresholds: Thresholds,
    learn_thresholds: bool,
    weight: float,
) -> dict[str, Tensor]:
    """What the windows of a look add to the loss, for the scene and for learned thresholds."""
    change = changes(light, events, response)
    terms = {"events": weight * count_error(change, events, thresholds)}
    if learn_thresholds:
        terms["thresholds"] = weight * threshold_error(change, events, thresholds)
    return terms


def changes(light: Radiance, events: EventPairs, response: Response) -> Float[Tensor, "m q h w c"]:
    """The change of log light over each window at every pixel.

    Args:
        light: Of the views of m looks, `[m, h, w, q + 1]`.
        events: Of their windows, `[m, q, h, w, c]`; c = 3 behind a colour filter.
        response: Light to the log of what a pixel reports.
    """
    first = events[:, 0].reshape(-1)
    rgb = light.rgb.flatten(0, 2).repeat_interleave(events.shape[-1], 0)  # [m h w c, q + 1, rgb]
    log = response(rgb, first)[..., 0]
    return (log[:, 1:] - log[:, :-1]).unflatten(0, events[:, 0].shape).movedim(-1, 1)


def count_error(
    change: Float[Tensor, "m q h w c"], events: EventPairs, thresholds: Thresholds
) -> Float[Tensor, ""]:
    """Mean square of the number of events that are too many or too few beyond their rounding.

    Thresholds learn nothing from this: structure so fine that the frames do not show it is told by
    events alone, and agrees with any threshold.
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
    """Mean square of the number of events from the first instant of a look to its last.

    What thresholds are learned from; the scene learns nothing. They do not go down the slope of
    this error, which would make them too small: a scene that is a little soft changes less than
    the light did, and one that is a little misplaced changes where it did not. Over blocks of
    pixels neither matters, so that the mean change of a block is compared with what of it the
    events of its pixels leave out, and each threshold is asked to grow by the part that is missing
    where the scene changed in its direction. (In the words of regression with errors on both
    sides, that mean is an instrument for the counts.) Over a long time, events that were rounded
    away and light that came back matter least.
    """
    whole = replace(
        events[:, 0], negative=events.negative.sum(1), positive=events.positive.sum(1), slack=None
    ).reshape(-1)
    negative, positive = thresholds(whole)
    total = change.detach().sum(1)
    shown = _of_blocks(total).reshape(-1)
    missing = total.reshape(-1) - whole.measured(negative.detach(), positive.detach())
    asked = shown * missing / shown.square().mean().clamp_min(TINY)
    pull = -(asked * torch.where(shown > 0, positive, negative).log()).mean()
    error = (missing / (negative * positive).detach().sqrt()).square().mean()
    return error + pull - pull.detach()


def _of_blocks(image: Float[Tensor, "m h w c"]) -> Float[Tensor, "m h w c"]:
    """Means over blocks of pixels, at each of their pixels."""
    height, width = image.shape[1:3]
    each = image.movedim(-1, 1)
    means = torch.nn.functional.avg_pool2d(each, BLOCK, ceil_mode=True, count_include_pad=False)
    wide = means.repeat_interleave(BLOCK, -1).repeat_interleave(BLOCK, -2)
    return wide[..., :height, :width].movedim(1, -1)
