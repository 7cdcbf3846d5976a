"""Output of a calibration: thresholds, a map of the thresholds of all pixels, an image of it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.files import replacing, write_json
from sharpfield.preparation.calibrate.measure import ThresholdCalibration
from sharpfield.preparation.thresholds import known_thresholds
from sharpfield.report.colormaps import colour_signs
from sharpfield.storage.arrays import write_arrays
from sharpfield.storage.images import write_image

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
        write_arrays(
            temporary,
            {
                "ratio": found.ratio,
                "deviating": found.deviating,
                "dead": found.dead,
                "hot": found.hot,
            },
        )
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
        "known": None
        if known is None
        else {"negative": known.negative, "positive": known.positive},
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
