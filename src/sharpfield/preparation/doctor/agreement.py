"""Check that frames and events agree, and find flipped axes, flipped polarity or a time shift.

The change of log light between two exposures is computed from the frames and from the events (see
`exposure_pairs`); their agreement is the correlation over the pixels. It is computed for all flips
and swaps of the event coordinates, for the other polarity, and for other times of the frames: the
variant that agrees clearly better shows the mistake.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from sharpfield.core.capture import Capture
from sharpfield.events.index import EventIndex, build_index
from sharpfield.preparation.calibrate.exposure_pairs import (
    ExposurePair,
    change_by_events,
    find_exposure_pairs,
)
from sharpfield.preparation.doctor.findings import Checkup, MeasuredCurve
from sharpfield.preparation.ingest.options import AxisFixes
from sharpfield.report.colormaps import colour_signs

PAIRS = 5
MAX_SHIFT_US, COARSE_US, FINE_US = 60_000, 6_000, 1_000
"""Time shifts of the frames: the largest, the coarse step, and the fine step around the best."""
SHIFT_US, SHIFT_GAIN = 6_000, 0.03
"""A shift is reported from this on, if the correlation gains so much."""
LATENCY_US, CLEAR_GAIN = 10_000, 0.1
"""A shorter shift that gains less may be the latency of the pixels, some ms in dim light."""
AGREES, BETTER = 0.4, 0.15
"""Correlation from which on frames and events agree, and what another axis convention must gain."""
POOR = 0.6
"""Correlation below which the agreement is a warning."""
LAST, NEXT = 0.3, 0.25
"""Typical change since the last event and before the next one, in thresholds."""
THRESHOLD = 0.2
"""Threshold of both polarities, which a correlation does not depend on; smaller changes are
ignored."""


AS_IS = AxisFixes()
CONVENTIONS = [AxisFixes(*parts) for parts in product((False, True), repeat=4)]


@dataclass(frozen=True)
class FrameEventAgreement:
    """How well frames and events agree."""

    correlation: float
    """With the events as they are."""
    best: AxisFixes
    shift_us: int
    """Time shift of the frames with the best agreement."""
    best_correlation: float
    unshifted: float
    """Correlation of the best convention without a time shift."""


def check_agreement(capture: Capture, checkup: Checkup) -> FrameEventAgreement | None:
    """Compare frames with events; None if they cannot be compared."""
    frames = capture.needed_frames
    if len(frames) < 2 or len(np.unique(frames.track)) == len(frames):
        checkup.add("note", "agreement", "a single frame cannot be compared with events")
        return None
    index = build_index(capture.needed_events)
    pairs = find_exposure_pairs(capture, most=PAIRS)
    from_frames = np.stack([pair.change.mean(-1) for pair in pairs])
    usable = np.stack([pair.usable.all(-1) for pair in pairs])  # [n, h, w]
    for change, good in zip(from_frames, usable, strict=True):  # without the gain of the frame
        change -= np.median(change[good]) if good.any() else 0.0
    shifts = np.arange(-MAX_SHIFT_US, MAX_SHIFT_US + 1, COARSE_US)
    scores = np.array(
        [
            [_score(one, from_frames, from_events, usable) for one in CONVENTIONS]
            for from_events in (
                _changes_by_events(capture, index, pairs, int(shift)) for shift in shifts
            )
        ]
    )
    now = float(scores[len(shifts) // 2, 0])
    at, which = np.unravel_index(scores.argmax(), scores.shape)
    best = CONVENTIONS[int(which)]
    if scores.max() < max(scores[:, 0].max() + BETTER, AGREES):
        best, at = AS_IS, int(scores[:, 0].argmax())
    fine = int(shifts[at]) + np.arange(-COARSE_US, COARSE_US + 1, FINE_US)
    finer = [
        _score(best, from_frames, _changes_by_events(capture, index, pairs, int(s)), usable)
        for s in fine
    ]
    column = CONVENTIONS.index(best)
    found = FrameEventAgreement(
        now,
        best,
        int(fine[int(np.argmax(finer))]),
        float(np.max(finer)),
        float(scores[len(shifts) // 2, column]),
    )
    order = np.argsort(np.concatenate([shifts, fine]))
    checkup.curves.append(
        MeasuredCurve(
            "Correlation of events with frames, for other times of the frames",
            "shift of the frames, ms",
            np.concatenate([shifts, fine])[order] / 1000,
            np.concatenate([scores[:, column], finer])[order],
        )
    )
    _add_findings(found, checkup)
    from_events = _changes_by_events(capture, index, pairs[:1], 0)[0]
    checkup.images["change between two exposures, by the frames"] = _signed_image(from_frames[0])
    checkup.images["change between two exposures, by the events"] = _signed_image(from_events)
    return found


def _score(
    fixes: AxisFixes,
    from_frames: Float64[np.ndarray, "n h w"],
    from_events: Float64[np.ndarray, "n h w"],
    usable: Bool[np.ndarray, "n h w"],
) -> float:
    """Correlation of the changes by frames with those by events, once corrected."""
    if fixes.swap_xy:
        side = min(from_events.shape[1:])
        from_events = from_events[:, :side, :side].swapaxes(1, 2)
        from_frames, usable = from_frames[:, :side, :side], usable[:, :side, :side]
    if fixes.flip_x:
        from_events = from_events[:, :, ::-1]
    if fixes.flip_y:
        from_events = from_events[:, ::-1]
    good = usable & ((from_events != 0) | (np.abs(from_frames) > THRESHOLD))
    if good.sum() < 100 or from_events[good].std() == 0 or from_frames[good].std() == 0:
        return 0.0
    found = float(
        np.corrcoef(np.clip(from_frames[good], -2, 2), np.clip(from_events[good], -2, 2))[0, 1]
    )
    return -found if fixes.flip_polarity else found


def _add_findings(found: FrameEventAgreement, checkup: Checkup) -> None:
    shifted = (
        abs(found.shift_us) >= SHIFT_US and found.best_correlation > found.unshifted + SHIFT_GAIN
    )
    got = f"correlation {found.correlation:.2f}"
    if found.best_correlation < AGREES:
        checkup.add(
            "error",
            "disagreement",
            "events do not explain the change between frames",
            got=f"{got}; no flip, swap or time shift of up to {MAX_SHIFT_US // 1000} ms helps",
            do="check that both files are of the same recording, and the encoding of the frames",
        )
        return
    better = f"{got}, {found.best_correlation:.2f} with"
    if found.best != AS_IS:
        name = (
            "polarity-flipped"
            if found.best == AxisFixes(flip_polarity=True)
            else "axes-swapped"
            if found.best.swap_xy
            else "mirrored"
        )
        words = " and ".join(found.best.words)
        checkup.add(
            "error",
            name,
            f"the events have {words}",
            got=f"{better} {words}",
            do=f"ingest again with {found.best.flags}",
        )
    if shifted:
        _add_shift(found, better, checkup)
    if found.best == AS_IS and not shifted:
        poor = found.correlation < POOR
        checkup.add(
            "warning" if poor else "note",
            "agreement",
            "events explain the change between frames" + (" only in part" if poor else ""),
            got=got,
            do="check thresholds, noise and saturation" if poor else "",
        )


def _add_shift(found: FrameEventAgreement, better: str, checkup: Checkup) -> None:
    gain = found.best_correlation - found.unshifted
    small = abs(found.shift_us) <= LATENCY_US and gain < CLEAR_GAIN
    late = -found.shift_us / 1000
    do = f"ingest with --offset-ms {-late:g}, or what is given now and {-late:+g}"
    if small:
        do += "; a shift below the latency of the pixels is no mistake, and costs little"
    checkup.add(
        "warning" if small else "error",
        "time-shift",
        f"frame times are {abs(late):.0f} ms too {'late' if late > 0 else 'early'} for the events",
        got=f"{better} frames {abs(late):.0f} ms {'earlier' if late > 0 else 'later'}",
        do=do,
    )


def _changes_by_events(
    capture: Capture, index: EventIndex, pairs: list[ExposurePair], shift_us: int
) -> Float64[np.ndarray, "n h w"]:
    """Changes of log light by the events, as maps over the pixels."""
    width, height = capture.camera.size
    even, thresholds = np.ones(len(index)), (THRESHOLD, THRESHOLD)
    maps = []
    for pair in pairs:
        sites = index.sites_of(int(capture.needed_frames.track[pair.frames[0]]))
        found = change_by_events(index, even, pair.shifted(shift_us), sites, thresholds)
        x, y = np.rint(index.site_xy[sites]).astype(np.int64).T
        at = np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)
        change = found.expected + THRESHOLD * (LAST * found.last + NEXT * found.next)
        total = np.bincount(at, change, minlength=width * height)
        many = np.maximum(np.bincount(at, minlength=width * height), 1)
        maps.append((total / many).reshape(height, width))
    return np.stack(maps)


def _signed_image(change: Float64[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Red where it got brighter, blue where darker."""
    return colour_signs(change, max(float(np.percentile(np.abs(change), 95)), 1e-6))
