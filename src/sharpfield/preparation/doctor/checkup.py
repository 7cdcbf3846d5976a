"""Checks of a capture before training on it.

The order is that in which one mistake would hide another: files, time units, each sensor by itself,
whether frames and events agree, and only then thresholds, poses and blur. Checks that an earlier
error makes meaningless are left out: fix it and check again.

The HTML page of a checkup: findings first, then the evidence.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.preparation.calibrate.measure import calibrate
from sharpfield.preparation.doctor.agreement import check_agreement
from sharpfield.preparation.doctor.events import check_layout, check_light, check_pixels, check_rate
from sharpfield.preparation.doctor.findings import Checkup, MeasuredCurve
from sharpfield.preparation.doctor.poses import check_blur, check_images, check_motion
from sharpfield.preparation.doctor.times import check_hold_out, check_poses_known, check_units
from sharpfield.preparation.options import CalibrateOptions
from sharpfield.preparation.thresholds import known_thresholds
from sharpfield.report.capture import capture_section
from sharpfield.report.page import CaptionedImage, ImageEncoding, write_page

PAIRS = 4
"""Pairs of exposures from which thresholds are estimated; fewer than for a calibration."""
MAX_ERROR, MAX_SIGMAS = 0.15, 3.0
"""Stated thresholds that differ by more than this share and so many standard deviations are
reported."""
MIN_CORRELATION = 0.5
"""Correlation of events and frames from which on the measured thresholds are trusted."""

READ_CHECKS = {
    "poses do not cover": "poses-missing",
    "not taken at the same time": "time-unit",
    "events lie outside the sensor": "axes-swapped",
}
"""Names of checks by the error text of the reader."""


def examine(capture: Capture) -> Checkup:
    """Run all checks that the capture allows."""
    checkup = Checkup(capture.name)
    in_time = check_units(capture, checkup)
    if capture.frames is not None:
        check_light(capture, checkup)
    aligned = check_layout(capture, checkup)
    if aligned:
        check_rate(capture, checkup)
        check_pixels(capture, checkup)
    agreed = False
    if aligned and in_time and capture.frames is not None and not checkup.has("error"):
        compared = _possible(checkup, "agreement", lambda: check_agreement(capture, checkup))
        agreed = compared and not checkup.has("error")
    if agreed:
        capture = _with_thresholds(capture, checkup)
    posed = in_time and check_poses_known(capture, checkup)
    if posed and not checkup.has("error"):
        if aligned:
            check_motion(capture, checkup)
        if capture.frames is not None and len(capture.frames) > 1:
            _possible(checkup, "poses-fit", lambda: check_images(capture, checkup))
            check_blur(capture, checkup)
    elif posed:
        checkup.add("note", "poses-fit", "poses were not checked: fix the errors first")
    check_hold_out(capture, checkup)
    return checkup


def examine_path(path: Path, *, layout: str | None = None) -> tuple[Checkup, Capture | None]:
    """Read a capture and check it; an error while reading is a finding, too."""
    try:
        capture = read_capture(path, ReadOptions(layout=layout), poses=False)
    except CaptureError as error:
        checkup = Checkup(path.resolve().name)
        names = [name for words, name in READ_CHECKS.items() if words in error.what]
        got = "; ".join(part for part in (error.where, error.got) if part)
        checkup.add("error", (names or ["unreadable"])[0], error.what, got=got, do=error.do)
        return checkup, None
    return examine(capture), capture


def _with_thresholds(capture: Capture, checkup: Checkup) -> Capture:
    """The capture with thresholds measured where it states none; adds a finding."""
    try:
        measured = calibrate(capture, CalibrateOptions(pairs=PAIRS))
    except CaptureError as error:
        checkup.add("note", "thresholds", f"thresholds cannot be measured: {error.what}")
        return capture
    got = (
        f"{measured.negative:.3f} +- {measured.negative_sigma:.3f} to darker,"
        f" {measured.positive:.3f} +- {measured.positive_sigma:.3f} to brighter"
    )
    stated = known_thresholds(capture)
    off = stated is not None and any(
        abs(value - expected) > max(MAX_ERROR * expected, MAX_SIGMAS * sigma)
        for value, expected, sigma in (
            (measured.negative, stated.negative, measured.negative_sigma),
            (measured.positive, stated.positive, measured.positive_sigma),
        )
    )
    if off and stated is not None and measured.explained > MIN_CORRELATION:
        checkup.add(
            "warning",
            "thresholds",
            "the stated thresholds differ from those that frames and events show",
            got=f"{got}; stated {stated.negative:.3g} and {stated.positive:.3g}",
            do="measure them with `sharpfield calibrate`, and give the result with --threshold",
        )
    else:
        checkup.add(
            "note", "thresholds", "contrast thresholds, estimated from frames and events", got=got
        )
    if stated is not None or measured.explained <= MIN_CORRELATION:
        return capture
    thresholds = Thresholds(measured.negative, measured.positive, "estimated")
    return replace(capture, known=replace(capture.known, thresholds=thresholds))


def _possible(checkup: Checkup, check: str, run: Callable[[], object]) -> bool:
    """Run a check; adds a note if the capture holds too little data for it."""
    try:
        return bool(run())
    except CaptureError as error:
        checkup.add(
            "note", check, f"could not be checked: {error.what}", got=error.got, do=error.do
        )
        return False


ENCODING = ImageEncoding(900, 82)
WIDTH, HEIGHT, MARGIN = 300, 170, 40
"""Of a plot, and the space for its labels."""
WIDE = 1.9
"""Width over height from which on an image gets a row of its own."""


def write_doctor_page(path: Path, checkup: Checkup, capture: Capture | None) -> None:
    """Write the page of a checkup; the capture is None if it could not be read."""
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
