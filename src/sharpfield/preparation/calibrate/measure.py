"""Contrast thresholds of an event camera, measured from a capture with frames and events.

The change of log light between two exposures by the frames is regressed on that by the events, for
every pixel (see `threshold_fit`). The uncertainty is a bootstrap over tiles of pixels and pairs.

Output of a calibration: thresholds, a map of the thresholds of all pixels, an image of it.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped, UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing, write_json
from sharpfield.core.seed import numpy_generator
from sharpfield.events.index import build_index
from sharpfield.preparation.calibrate.exposure_pairs import find_exposure_pairs
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
from sharpfield.preparation.thresholds import known_thresholds
from sharpfield.report.colormaps import colour_signs
from sharpfield.storage.arrays import write_arrays
from sharpfield.storage.images import write_image

ROUNDS = 8
"""Gauss-Newton steps."""

MIN_EQUATIONS, MAX_EQUATIONS = 200, 200_000
MIN_CHANGE = 0.02
"""Mean absolute change of log light below which nothing moved."""

MODEL_ERROR = 0.015
"""Error of the sensor model as a share of the threshold: RMS error on simulated sensors, which the
bootstrap does not include."""

MIN_SIGNAL = 4.0
"""A pixel is measured if the change by its events is so many standard deviations."""

MIN_SIGMAS, MIN_DEVIATION = 5.0, 0.35
"""A deviating pixel differs by so many standard deviations and by this share of the threshold."""


@dataclass(frozen=True)
class ThresholdCalibration:
    """Thresholds with their uncertainty, and maps of single pixels."""

    negative: float
    """Threshold of events to darker; natural log."""
    positive: float
    """Threshold of events to brighter; natural log."""
    negative_sigma: float
    """One standard deviation."""
    positive_sigma: float
    dead_us: float
    """Refractory time of a pixel after an event."""
    late_ms: float
    """Latency of the events relative to the frames."""
    explained: float
    """Correlation of the changes by events with those by frames."""
    residual: float
    """Robust standard deviation of the difference, natural log."""
    drift: float
    """Change of log light per pair that no event explains: gain of the frames, or leak events."""
    equations: int
    """Number of equations: usable sites of all pairs."""
    pairs: int
    """Number of exposure pairs."""
    ratio: Float32[np.ndarray, "h w"]
    """Threshold of each pixel over the common one; NaN where there is too little signal."""
    deviating: Bool[np.ndarray, "h w"]
    """Pixels whose threshold differs significantly, by more than `MIN_DEVIATION`."""
    dead: Bool[np.ndarray, "h w"]
    """Pixels without events although their neighbours have some."""
    hot: Bool[np.ndarray, "h w"]
    """Pixels with many more events than their neighbours."""


def calibrate(capture: Capture, options: CalibrateOptions) -> ThresholdCalibration:
    """Measure thresholds from frames and events of the same pixels; poses are not used.

    Raises:
        CaptureError: Frames or events are missing, or too little changed.
    """
    index = build_index(capture.needed_events)
    pairs = find_exposure_pairs(capture, most=options.pairs)
    _, hot = odd_pixels(counts(capture.needed_events))
    every = Equations.of(capture, index, pairs, without=hot)
    some = Equations.of(capture, index, pairs, without=hot, most=MAX_EQUATIONS)
    some = with_events_around(some)
    if len(some.change) < MIN_EQUATIONS or np.abs(some.change).mean() < MIN_CHANGE:
        raise CaptureError(
            "too little changed between frames to measure thresholds",
            where=capture.name,
            got=f"{len(some.change)} usable pixels with events",
            do="record a moving scene or camera, neither under- nor overexposed",
        )
    longest, fit = longest_dead_us(index), Fit.at(some, START)
    for _ in range(ROUNDS):
        fit = Fit.at(some, Normal.of(some, fit).step(fit.terms, longest))
    draw = numpy_generator(options.seed, 0, "calibrate")
    sigma = np.hypot(Normal.of(some, fit).spread(fit.terms, longest, draw), MODEL_ERROR * fit.terms)
    return ThresholdCalibration(
        negative=float(fit.terms[NEGATIVE]),
        positive=float(fit.terms[POSITIVE]),
        negative_sigma=float(sigma[NEGATIVE]),
        positive_sigma=float(sigma[POSITIVE]),
        dead_us=float(fit.terms[DEAD_US]),
        late_ms=float(fit.terms[LATE_MS]),
        explained=fit.explained,
        residual=1.4826 * float(np.median(np.abs(fit.residual))),
        drift=float(fit.terms[DRIFT]),
        equations=len(some.change),
        pairs=len(pairs),
        **_pixels(capture, every, Fit.at(every, fit.terms)),
    )


def _pixels(
    capture: Capture, equations: Equations, fit: Fit
) -> dict[str, Shaped[np.ndarray, "h w"]]:
    """Maps of the pixels, from the equations of each."""
    width, height = capture.camera.size
    at = np.concatenate(equations.pixel)
    scale = 1.4826 * float(np.median(np.abs(fit.residual)))

    def total(values: Float64[np.ndarray, "e"]) -> Float64[np.ndarray, "h w"]:
        return np.bincount(at, values, minlength=width * height).reshape(height, width)

    by_events = total(fit.expected**2)
    enough = by_events > (MIN_SIGNAL * scale) ** 2
    ratio = total(equations.change * fit.expected) / np.where(enough, by_events, 1)
    sigma = scale / np.sqrt(np.where(enough, by_events, 1))
    off = (np.abs(ratio - 1) > MIN_SIGMAS * sigma) & (np.abs(ratio - 1) > MIN_DEVIATION)
    dead, hot = odd_pixels(counts(capture.needed_events))
    return {
        "ratio": np.where(enough, ratio, np.nan).astype(np.float32),
        "deviating": enough & off & ~hot,
        "dead": dead,
        "hot": hot,
    }


NUMBERS, PIXELS, IMAGE = "calibration.json", "pixels.npz", "pixels.png"

FULL_LOG_RATIO = 0.5
"""Log of the ratio of thresholds that gets the full colour: a factor of about 1.65 either way."""
UNKNOWN, DEAD, HOT = (205, 205, 205), (0, 0, 0), (245, 170, 30)


def write_calibration(capture: Capture, found: ThresholdCalibration, out: Path) -> dict[str, Any]:
    """Write `calibration.json`, `pixels.npz` and `pixels.png` to a folder; returns the numbers."""
    out.mkdir(parents=True, exist_ok=True)
    about = calibration_summary(capture, found)
    write_json(out / NUMBERS, about)
    with replacing(out / PIXELS) as temporary:
        maps = ("ratio", "deviating", "dead", "hot")
        write_arrays(temporary, {name: getattr(found, name) for name in maps})
    write_image(out / IMAGE, pixel_image(found))
    return about


def calibration_summary(capture: Capture, found: ThresholdCalibration) -> dict[str, Any]:
    """Plain values for JSON. Thresholds are natural log; `sigma` is one standard deviation."""
    known = known_thresholds(capture)
    return {
        "capture": capture.name,
        "threshold": {
            "negative": _rounded(found.negative, found.negative_sigma),
            "positive": _rounded(found.positive, found.positive_sigma),
        },
        "known": None if known is None else asdict(known),
        "dead_us": round(found.dead_us, 1),
        "late_ms": round(found.late_ms, 2),
        "explained": round(found.explained, 4),
        "residual": round(found.residual, 4),
        "drift_per_pair": round(found.drift, 4),
        "equations": found.equations,
        "pairs": found.pairs,
        "pixels": {
            "judged": int(np.isfinite(found.ratio).sum()),
            "deviating": int(found.deviating.sum()),
            "dead": int(found.dead.sum()),
            "hot": int(found.hot.sum()),
        },
    }


def calibration_text(about: dict[str, Any]) -> str:
    """The summary in lines for a terminal."""
    lines = []
    for sign, name in (("negative", "darker"), ("positive", "brighter")):
        measured = about["threshold"][sign]
        line = f"threshold to {name:<9} {measured['value']:.4f} +- {measured['sigma']:.4f}"
        if about["known"] is not None:
            line += f"   (stated in the capture: {about['known'][sign]:.4g})"
        lines.append(line)
    pixels = about["pixels"]
    lines += [
        f"events explain the frames with a correlation of {about['explained']:.3f},"
        f" {about['equations']:,} equations of {about['pairs']} pairs of exposures",
        f"refractory time {about['dead_us']:.0f} us, latency {about['late_ms']:.1f} ms",
        f"pixels: {pixels['judged']:,} measured, {pixels['deviating']} deviate,"
        f" {pixels['dead']} dead, {pixels['hot']} hot",
    ]
    return "\n".join(lines)


def pixel_image(found: ThresholdCalibration) -> UInt8[np.ndarray, "h w 3"]:
    """Thresholds as colours: red above the common one, blue below.

    Grey pixels are unknown, black ones dead, amber ones hot; deviating ones get a ring.
    """
    log_ratio = np.log(np.where(np.isfinite(found.ratio), found.ratio, 1).clip(0.05, 20))
    image = colour_signs(log_ratio, FULL_LOG_RATIO)
    image[~np.isfinite(found.ratio)] = UNKNOWN
    image[found.dead] = DEAD
    image[found.hot] = HOT
    zoom = 3 if found.ratio.shape[1] < 480 else 1
    large = np.ascontiguousarray(np.kron(image, np.ones((zoom, zoom, 1), np.uint8)))
    for y, x in np.argwhere(found.deviating):
        centre = (int(zoom * x + zoom // 2), int(zoom * y + zoom // 2))
        cv2.circle(large, centre, 2 * zoom, (0, 0, 0), 1, cv2.LINE_AA)
    return large


def _rounded(value: float, sigma: float) -> dict[str, float]:
    return {"value": round(value, 5), "sigma": round(sigma, 5)}
