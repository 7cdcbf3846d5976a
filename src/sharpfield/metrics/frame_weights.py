"""How much each frame counts, from how blurred it is."""

from typing import Literal

import numpy as np
from jaxtyping import Float64

from sharpfield.core.capture import Capture
from sharpfield.metrics.quality import quality, quality_weights
from sharpfield.storage.result_cache import kept

Judge = Literal["published", "auto", "images", "events"]
"""As published; by events where there are any, else by images; by images; by events."""


def frame_weights(capture: Capture, judge: Judge) -> Float64[np.ndarray, "n"]:
    """A weight for each frame: about 1 on average over those learned from, and 1 for the others.

    What images tell about long captures is kept, see `captures.kept`.

    Raises:
        CaptureError: Events are to tell, and there are none.
    """
    by_events = capture.events is not None and capture.events.track is None
    if judge == "events" or (judge == "auto" and by_events):
        return quality_weights(capture, source="events")
    return kept(capture, "quality", {"judge": judge}, lambda: {"weights": _seen(capture, judge)})[
        "weights"
    ]


def _seen(capture: Capture, judge: Judge) -> Float64[np.ndarray, "n"]:
    if judge != "published":
        return quality_weights(capture, source="images")
    weights = np.ones(len(capture.needed_frames))
    found = quality(capture, way="published")
    weights[found.frames] = found.weights
    return weights
