"""What calibration leaves behind: numbers, a map of the pixels' thresholds, a image of it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.files import replacing, write_json
from sharpfield.preparation.calibrate.measure import Calibration
from sharpfield.preparation.thresholds import known_thresholds
from sharpfield.storage.arrays import write_arrays
from sharpfield.storage.images import write_image

NUMBERS, PIXELS, IMAGE = "calibration.json", "pixels.npz", "pixels.png"

WIDEST = 0.5
"""Log of the ratio of thresholds that gets the full colour: a factor of about 1.65 either way."""
BLUE, WHITE, RED = (38, 86, 190), (255, 255, 255), (200, 32, 38)
UNKNOWN, DEAD, HOT = (205, 205, 205), (0, 0, 0), (245, 170, 30)


def write_calibration(capture: Capture, made: Calibration, out: Path) -> dict[str, Any]:
    """Write `calibration.json`, `pixels.npz` and `pixels.png` to a folder; returns the numbers."""
    out.mkdir(parents=True, exist_ok=True)
    about = summary(capture, made)
    write_json(out / NUMBERS, about)
    with replacing(out / PIXELS) as temporary:
        write_arrays(
            temporary,
            {
                "ratio": made.ratio,
                "deviating": made.deviating,
                "dead": made.dead,
                "hot": made.hot,
            },
        )
    write_image(out / IMAGE, pixel_image(made))
    return about


def summary(capture: Capture, made: Calibration) -> dict[str, Any]:
    """Plain values, ready for JSON. Thresholds are in natural log; `sigma` is one deviation."""
    known = known_thresholds(capture)
    return {
        "capture": capture.name,
        "threshold": {
            "negative": _of(made.negative, made.negative_sigma),
            "positive": _of(made.positive, made.positive_sigma),
        },
        "known": None
        if known is None
        else {"negative": known.negative, "positive": known.positive},
        "dead_us": round(made.dead_us, 1),
        "late_ms": round(made.late_ms, 2),
        "explained": round(made.explained, 4),
        "residual": round(made.residual, 4),
        "drift_per_pair": round(made.drift, 4),
        "equations": made.equations,
        "pairs": made.pairs,
        "pixels": {
            "judged": int(np.isfinite(made.ratio).sum()),
            "deviating": int(made.deviating.sum()),
            "dead": int(made.dead.sum()),
            "hot": int(made.hot.sum()),
        },
    }


def as_text(about: dict[str, Any]) -> str:
    """The summary in lines for a terminal."""
    lines = []
    for sign, name in (("negative", "darker"), ("positive", "brighter")):
        found = about["threshold"][sign]
        line = f"threshold to {name:<9} {found['value']:.4f} +- {found['sigma']:.4f}"
        if about["known"] is not None:
            line += f"   (the capture says {about['known'][sign]:.4g})"
        lines.append(line)
    pixels = about["pixels"]
    lines += [
        f"events explain the frames with a correlation of {about['explained']:.3f},"
        f" {about['equations']:,} equations of {about['pairs']} pairs of exposures",
        f"pixels are dead for {about['dead_us']:.0f} us after an event, and"
        f" {about['late_ms']:.1f} ms late",
        f"pixels: {pixels['judged']:,} judged, {pixels['deviating']} deviate,"
        f" {pixels['dead']} dead, {pixels['hot']} hot",
    ]
    return "\n".join(lines)


def pixel_image(made: Calibration) -> UInt8[np.ndarray, "h w 3"]:
    """Thresholds as colours: red above the common one, blue below.

    Grey pixels are unknown, black ones dead, amber ones hot; those that deviate get a ring.
    """
    strength = np.log(np.where(np.isfinite(made.ratio), made.ratio, 1).clip(0.05, 20)) / WIDEST
    strength = np.clip(strength, -1, 1)[..., None]
    full = np.where(strength > 0, np.array(RED), np.array(BLUE))
    image = np.array(WHITE) + np.abs(strength) * (full - np.array(WHITE))
    image[~np.isfinite(made.ratio)] = UNKNOWN
    image[made.dead] = DEAD
    image[made.hot] = HOT
    zoom = 3 if made.ratio.shape[1] < 480 else 1
    large = np.ascontiguousarray(np.kron(image, np.ones((zoom, zoom, 1))).round().astype(np.uint8))
    for y, x in np.argwhere(made.deviating):
        centre = (int(zoom * x + zoom // 2), int(zoom * y + zoom // 2))
        cv2.circle(large, centre, 2 * zoom, (0, 0, 0), 1, cv2.LINE_AA)
    return large


def _of(value: float, sigma: float) -> dict[str, float]:
    return {"value": round(value, 5), "sigma": round(sigma, 5)}
