"""A score of a model that is still being trained: a few held-out views, rendered now and then."""

from collections.abc import Callable

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Model
from sharpfield.core.selection import evenly_spread
from sharpfield.evaluation.reference import held_out
from sharpfield.evaluation.views import brightness_of, seen_at
from sharpfield.metrics import psnr

VIEWS = 2
"""Held-out views that are rendered."""


def validation(capture: Capture, *, views: int = VIEWS) -> Callable[[Model], float] | None:
    """What tells the mean PSNR of some held-out views of a model, as `evaluate` measures it.

    Args:
        capture: What the model learns from, with its held-out frames, as read.
        views: How many; the same ones every time, evenly spread.

    Returns:
        The score; None where there is no picture to compare with.
    """
    known = [reference for reference in held_out(capture) if reference.image is not None]
    if not known:
        return None
    chosen = [known[i] for i in evenly_spread(np.arange(len(known)), views)]

    def mean_psnr(model: Model) -> float:
        seen = [seen_at(model, reference, capture) for reference in chosen]
        brightness = brightness_of(model, seen)
        scores = [
            psnr(brightness.picture(view.light), brightness.reference(image))
            for view in seen
            if (image := view.reference.image) is not None
        ]
        return float(sum(scores)) / len(scores)

    return mean_psnr
