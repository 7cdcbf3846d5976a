"""The HTML page of a checkup: findings first, then the evidence."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.preparation.doctor.findings import Checkup, MeasuredCurve
from sharpfield.report.capture import capture_section
from sharpfield.report.page import CaptionedImage, ImageEncoding, write_page

ENCODING = ImageEncoding(900, 82)
WIDTH, HEIGHT, MARGIN = 300, 170, 40
"""Of a plot, and the space for its labels."""
WIDE = 1.9
"""Width over height from which on an image gets a row of its own."""


def write_doctor_page(path: Path, checkup: Checkup, capture: Capture | None) -> None:
    """Write the page.

    Args:
        path: The file.
        checkup: Its findings and evidence.
        capture: What was checked; None if it could not be read.
    """
    images = [
        CaptionedImage("evidence", np.ascontiguousarray(pixels), caption, caption.capitalize())
        for caption, pixels in checkup.images.items()
    ]
    wide = [one.pixels.shape[1] > WIDE * one.pixels.shape[0] for one in images]
    curves = [one for one in checkup.curves if len(one.x) > 1 and np.isfinite(one.y).all()]
    values = {
        "title": f"{checkup.name}: checkup",
        "heading": checkup.name,
        "verdict": verdict(checkup),
        "cards": [(str(count), f"{kind}s", "") for kind, count in checkup.counts.items()],
        "findings": [asdict(one) for one in checkup.sorted],
        "narrow_images": [one for one, alone in zip(images, wide, strict=True) if not alone],
        "wide_images": [one for one, alone in zip(images, wide, strict=True) if alone],
        "curves": [_plot(one) for one in curves],
        "capture": None if capture is None else capture_section(capture),
        "encoding": ENCODING,
    }
    write_page(path, "doctor.html.j2", values)


def verdict(checkup: Checkup) -> str:
    """The result in one sentence."""
    counts = checkup.counts
    if counts["error"]:
        summary = f"{counts['error']} error{'s' * (counts['error'] > 1)} to fix before training"
    else:
        summary = "ready for training"
    warnings = counts["warning"]
    return summary + (f", {warnings} warning{'s' * (warnings > 1)}" if warnings else "")


def _plot(curve: MeasuredCurve) -> dict[str, Any]:
    """A line plot with its extremes labelled, as coordinates in the SVG."""
    left, right = float(curve.x.min()), float(curve.x.max())
    low, high = float(curve.y.min()), float(curve.y.max())
    x = MARGIN + (curve.x - left) / max(right - left, 1e-12) * (WIDTH - 2 * MARGIN)
    y = HEIGHT - MARGIN - (curve.y - low) / max(high - low, 1e-12) * (HEIGHT - 2 * MARGIN)
    return {
        "title": curve.title,
        "width": WIDTH,
        "height": HEIGHT,
        "axes": f"M{MARGIN},{MARGIN}V{HEIGHT - MARGIN}H{WIDTH - MARGIN}",
        "points": " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True)),
        "labels": [
            (MARGIN, HEIGHT - MARGIN + 16, "middle", f"{left:.4g}"),
            (WIDTH - MARGIN, HEIGHT - MARGIN + 16, "middle", f"{right:.4g}"),
            (WIDTH / 2, HEIGHT - 8, "middle", curve.x_label),
            (MARGIN - 6, HEIGHT - MARGIN, "end", f"{low:.2g}"),
            (MARGIN - 6, MARGIN + 4, "end", f"{high:.2g}"),
        ],
    }
