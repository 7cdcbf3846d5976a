"""Contrast thresholds of an event camera, measured from any capture that has frames as well.

What the frames say changed between two exposures is set against what the events say, for every
pixel (see `threshold_fit`). The uncertainty is a bootstrap over tiles of pixels and pairs.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.seed import numpy_generator
from sharpfield.events.index import build_index
from sharpfield.preparation.calibrate.exposure_pairs import exposure_pairs
from sharpfield.preparation.calibrate.threshold_fit import (
    DEAD_US,
    DRIFT,
    LATE_MS,
    NEGATIVE,
    POSITIVE,
    START,
    Equations,
    Fit,
    Normal,
    longest_dead_us,
    with_events_around,
)
from sharpfield.preparation.doctor.events import counts, odd_pixels
from sharpfield.preparation.options import CalibrateOptions

ROUNDS = 8
"""Gauss-Newton steps."""

LEAST_EQUATIONS, MOST_EQUATIONS = 200, 200_000
LEAST_CHANGE = 0.02
"""Mean absolute change of log light below which nothing moved."""

MODEL = 0.015
"""What the terms leave out of a sensor, as a share of a threshold: root mean square of the errors
on simulated sensors, which the draws do not show."""

ENOUGH = 4.0
"""Events of a pixel must say so many standard deviations of change for it to be judged."""

SURE = 5.0
OFF_BY = 0.35
"""A deviating pixel is off by so many standard deviations, and by this share of the threshold."""


@dataclass(frozen=True)
class Calibration:
    """Thresholds with their uncertainty, and pixels that differ."""

    negative: float
    positive: float
    negative_sigma: float
    """One standard deviation."""
    positive_sigma: float
    dead_us: float
    """Dead time of a pixel after an event."""
    late_ms: float
    """By how much events come later than the light of the frames changes."""
    explained: float
    """Correlation of what the events say with what the frames saw."""
    residual: float
    """Robust standard deviation of the difference, natural log."""
    drift: float
    """Change of log light per pair that no event accounts for: gain of the frames, or leak."""
    equations: int
    pairs: int
    ratio: Float32[np.ndarray, "h w"]
    """Threshold of each pixel over the common one; NaN where too little happened to tell."""
    deviating: Bool[np.ndarray, "h w"]
    """Pixels that surely differ by more than `OFF_BY`."""
    dead: Bool[np.ndarray, "h w"]
    """Without any event although the frames changed."""
    hot: Bool[np.ndarray, "h w"]
    """With many more events than the pixels around them."""


def calibrate(capture: Capture, options: CalibrateOptions) -> Calibration:
    """Measure thresholds.

    Args:
        capture: With frames and events of the same pixels; poses are not looked at.
        options: How much to look at.

    Raises:
        CaptureError: Frames or events are missing, or nothing moved.
    """
    index = build_index(capture.needed_events)
    pairs = exposure_pairs(capture, most=options.pairs)
    _, hot = odd_pixels(counts(capture.needed_events))
    every = Equations.of(capture, index, pairs, without=hot)
    some = Equations.of(capture, index, pairs, without=hot, most=MOST_EQUATIONS)
    some = with_events_around(some)
    if len(some.seen) < LEAST_EQUATIONS or np.abs(some.seen).mean() < LEAST_CHANGE:
        raise CaptureError(
            "too little changed between frames to measure thresholds",
            where=capture.name,
            got=f"{len(some.seen)} usable pixels with events",
            do="record something that moves, neither too dark nor saturated",
        )
    longest, fit = longest_dead_us(index), Fit.at(some, START)
    for _ in range(ROUNDS):
        fit = Fit.at(some, Normal.of(some, fit).step(fit.terms, longest))
    draw = numpy_generator(options.seed, 0, "calibrate")
    sigma = np.hypot(Normal.of(some, fit).spread(fit.terms, longest, draw), MODEL * fit.terms)
    return Calibration(
        negative=float(fit.terms[NEGATIVE]),
        positive=float(fit.terms[POSITIVE]),
        negative_sigma=float(sigma[NEGATIVE]),
        positive_sigma=float(sigma[POSITIVE]),
        dead_us=float(fit.terms[DEAD_US]),
        late_ms=float(fit.terms[LATE_MS]),
        explained=fit.explained,
        residual=1.4826 * float(np.median(np.abs(fit.left))),
        drift=float(fit.terms[DRIFT]),
        equations=len(some.seen),
        pairs=len(pairs),
        **_pixels(capture, every, Fit.at(every, fit.terms)),
    )


def _pixels(
    capture: Capture, equations: Equations, fit: Fit
) -> dict[str, Shaped[np.ndarray, "h w"]]:
    """Maps of what single pixels do, by the equations of each."""
    width, height = capture.camera.size
    at = np.concatenate(equations.place)
    scale = 1.4826 * float(np.median(np.abs(fit.left)))

    def total(values: Float64[np.ndarray, "e"]) -> Float64[np.ndarray, "h w"]:
        return np.bincount(at, values, minlength=width * height).reshape(height, width)

    events_say = total(fit.expected**2)
    enough = events_say > (ENOUGH * scale) ** 2
    ratio = total(equations.seen * fit.expected) / np.where(enough, events_say, 1)
    sigma = scale / np.sqrt(np.where(enough, events_say, 1))
    off = (np.abs(ratio - 1) > SURE * sigma) & (np.abs(ratio - 1) > OFF_BY)
    dead, hot = odd_pixels(counts(capture.needed_events))
    return {
        "ratio": np.where(enough, ratio, np.nan).astype(np.float32),
        "deviating": enough & off & ~hot,
        "dead": dead,
        "hot": hot,
    }
