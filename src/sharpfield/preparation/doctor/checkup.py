"""A checkup of a capture before hours are spent on it.

Everything is looked at in the order in which one mistake would hide another: the files, units of
time, the two sensors by themselves, whether frames and events tell of the same light, and only then
thresholds, poses and blur. What a mistake makes meaningless is not judged: mend it and look again.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.preparation.calibrate.measure import calibrate
from sharpfield.preparation.doctor.agreement import check_agreement
from sharpfield.preparation.doctor.events import check_layout, check_light, check_pixels, check_rate
from sharpfield.preparation.doctor.findings import Checkup
from sharpfield.preparation.doctor.poses import check_blur, check_images, check_motion
from sharpfield.preparation.doctor.times import check_hold_out, check_poses_known, check_units
from sharpfield.preparation.options import CalibrateOptions
from sharpfield.preparation.thresholds import known_thresholds

PAIRS = 4
"""Pairs of exposures for the thresholds: an estimate, not a calibration."""
FAR_OFF, SIGMAS = 0.15, 3.0
"""Known thresholds are doubted if they are off by this share, and so many standard deviations."""
EXPLAINS = 0.5

READ_CHECKS = {
    "poses do not cover": "poses-missing",
    "not taken at the same time": "time-unit",
    "events lie outside the sensor": "axes-swapped",
}
"""What the reader's words mean, in names of checks."""


def examine(capture: Capture) -> Checkup:
    """Look at everything that is there."""
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
        agreed = _tried(checkup, "agreement", lambda: _agree(capture, checkup))
    if agreed:
        capture = _with_thresholds(capture, checkup)
    posed = in_time and check_poses_known(capture, checkup)
    if posed and not checkup.has("error"):
        if aligned:
            check_motion(capture, checkup)
        if capture.frames is not None and len(capture.frames) > 1:
            _tried(checkup, "poses-fit", lambda: check_images(capture, checkup))
            check_blur(capture, checkup)
    elif posed:
        checkup.say("note", "poses-fit", "poses were not judged: mend the errors first")
    check_hold_out(capture, checkup)
    return checkup


def examine_path(path: Path, *, layout: str | None = None) -> tuple[Checkup, Capture | None]:
    """Read a capture and look at it; what keeps it from being read is a finding, too."""
    try:
        capture = read_capture(path, ReadOptions(layout=layout), poses=False)
    except CaptureError as error:
        checkup = Checkup(path.resolve().name)
        names = [name for words, name in READ_CHECKS.items() if words in error.what]
        got = "; ".join(part for part in (error.where, error.got) if part)
        checkup.say("error", (names or ["unreadable"])[0], error.what, got=got, do=error.do)
        return checkup, None
    return examine(capture), capture


def _agree(capture: Capture, checkup: Checkup) -> bool:
    found = check_agreement(capture, checkup)
    return found is not None and not checkup.has("error")


def _with_thresholds(capture: Capture, checkup: Checkup) -> Capture:
    """The capture with thresholds measured where it knows none; says what was measured."""
    try:
        made = calibrate(capture, CalibrateOptions(pairs=PAIRS))
    except CaptureError as error:
        checkup.say("note", "thresholds", f"thresholds cannot be measured: {error.what}")
        return capture
    got = (
        f"{made.negative:.3f} +- {made.negative_sigma:.3f} to darker,"
        f" {made.positive:.3f} +- {made.positive_sigma:.3f} to brighter"
    )
    known = known_thresholds(capture)
    off = known is not None and any(
        abs(found - said) > max(FAR_OFF * said, SIGMAS * sigma)
        for found, said, sigma in (
            (made.negative, known.negative, made.negative_sigma),
            (made.positive, known.positive, made.positive_sigma),
        )
    )
    if off and known is not None and made.explained > EXPLAINS:
        checkup.say(
            "warning",
            "thresholds",
            "the thresholds that the capture knows are not those that its frames show",
            got=f"{got}; known {known.negative:.3g} and {known.positive:.3g}",
            do="measure them with `sharpfield calibrate`, and give the result with --threshold",
        )
    else:
        checkup.say("note", "thresholds", "contrast thresholds, by frames and events", got=got)
    if known is not None or made.explained <= EXPLAINS:
        return capture
    measured = Thresholds(made.negative, made.positive, "estimated")
    return replace(capture, known=replace(capture.known, thresholds=measured))


def _tried(checkup: Checkup, check: str, look: Callable[[], object]) -> bool:
    """Look; if the capture holds too little for that, say so."""
    try:
        return bool(look())
    except CaptureError as error:
        checkup.say("note", check, f"could not be judged: {error.what}", got=error.got, do=error.do)
        return False
