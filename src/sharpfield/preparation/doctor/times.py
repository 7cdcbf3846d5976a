"""Checks of times: units, overlap of frames, events and poses, exposures, held-out frames."""

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.geometry.trajectory import Stamped, Tracks
from sharpfield.preparation.doctor.findings import Checkup
from sharpfield.storage.event_file import THOUSAND

SHORTEST_US, LONGEST_US = 20, 2_000_000
"""Plausible exposure times; others are probably in another unit."""
LONGEST_INTERVAL_S = 20.0
"""Longest plausible time between frames of a recording with events."""
GAP_TIMES, GAP_US = 6.0, 30_000
"""A gap between poses is reported if it is so many times the median one, and so long."""
OUTSIDE, OUTSIDE_ERROR = 0.1, 0.3
"""Shares of events without a pose that are reported, and that are an error beside frames."""


def check_units(capture: Capture, checkup: Checkup) -> bool:
    """Whether times of frames and events are in one unit and overlap; adds findings."""
    frames, events = capture.frames, capture.events
    if frames is None or events is None or not len(events):
        return True
    if capture.known.motion == "unknown":
        checkup.add("note", "times", "frames have made-up times, so events cannot be compared")
        return False
    spans = {
        "events": (int(events.t_us[0]), int(events.t_us[-1])),
        "frames": (int(frames.exposure.open_us.min()), int(frames.exposure.close_us.max())),
    }
    durations = {name: max(last - first, 1) for name, (first, last) in spans.items()}
    got = ", ".join(f"{name} from {a} to {b} us" for name, (a, b) in spans.items())
    ratio = durations["events"] / durations["frames"]
    if len(frames) > 1:
        for larger, factor in (("event", ratio), ("frame", 1 / ratio)):
            if THOUSAND[0] < factor < THOUSAND[1]:
                checkup.add(
                    "error",
                    "time-unit",
                    f"{larger} times look like ns that were read as us",
                    got=f"{got}: a factor of {factor:.0f}",
                    do=f"divide the {larger} times by 1000, or ingest again with unit ns",
                )
                return False
    common = min(spans["events"][1], spans["frames"][1]) - max(
        spans["events"][0], spans["frames"][0]
    )
    if common < 0:
        checkup.add(
            "error",
            "no-overlap",
            "frames and events were not taken at the same time",
            got=got,
            do="check that both clocks count from the same instant",
        )
        return False
    return _plausible(capture, checkup)


def _plausible(capture: Capture, checkup: Checkup) -> bool:
    """Whether intervals, exposures and coverage by events are plausible."""
    exposure, events = capture.needed_frames.exposure, capture.needed_events
    apart = np.diff(np.sort(exposure.open_us))
    if len(apart) and np.median(apart) > 1e6 * LONGEST_INTERVAL_S:
        checkup.add(
            "error",
            "time-unit",
            "all times look like ns that were read as us",
            got=f"{np.median(apart) / 1e6:.0f} s between frames",
            do="divide all times by 1000, or ingest again with unit ns",
        )
        return False
    exposures_us = exposure.duration_us[~exposure.instant]
    outside = (exposure.open_us < events.t_us[0]) | (exposure.close_us > events.t_us[-1])
    if outside.any():
        checkup.add(
            "warning",
            "coverage",
            f"{outside.sum()} of {len(exposure)} exposures are not covered by events",
            got=f"frames {', '.join(map(str, np.flatnonzero(outside)[:8]))}",
            do="cut the recording to the time that both cameras ran",
        )
    if len(exposures_us) and not SHORTEST_US <= np.median(exposures_us) <= LONGEST_US:
        checkup.add(
            "error",
            "exposure-unit",
            "exposure times are implausibly long or short",
            got=f"median {np.median(exposures_us):.0f} us",
            do="give exposure times in us",
        )
    elif len(exposures_us):
        share = np.median(exposures_us) / max(float(np.median(apart)) if len(apart) else 1, 1)
        checkup.add(
            "note",
            "exposure",
            f"{len(exposures_us)} frames are exposed for {np.median(exposures_us) / 1000:.1f} ms,"
            f" {share:.0%} of the interval between frames",
        )
    else:
        checkup.add("note", "exposure", "no frame has an exposure time: all are treated as sharp")
    return True


def check_poses_known(capture: Capture, checkup: Checkup) -> bool:
    """Whether there are poses without gaps for all that was recorded."""
    if capture.known.poses == "unknown":
        checkup.add(
            "warning",
            "poses-unknown",
            "the camera poses are unknown",
            do="find the poses with `sharpfield poses`",
        )
        return False
    path = capture.trajectory
    moving = path.moving if isinstance(path, Tracks) else [path]
    sound = True
    for number, one in enumerate(moving):
        if not isinstance(one, Stamped) or len(one.times_us) < 4:
            continue
        apart = np.diff(one.times_us)
        worst = int(apart.argmax())
        if apart[worst] > max(GAP_TIMES * np.median(apart), GAP_US):
            sound = False
            checkup.add(
                "error",
                "poses-missing",
                f"the trajectory of track {number} has a gap",
                got=f"no pose from {one.times_us[worst]} to {one.times_us[worst + 1]} us; the"
                f" median interval is {np.median(apart):.0f} us",
                do="complete the trajectory, find poses with `sharpfield poses`, or cut the"
                " recording there",
            )
    return _events_posed(capture, checkup) and sound


def _events_posed(capture: Capture, checkup: Checkup) -> bool:
    """Whether the poses cover the events."""
    events = capture.events
    known = capture.trajectory.known_us(0)
    if events is None or known is None or not len(events):
        return True
    first, last = np.searchsorted(events.t_us, (known[0], known[1] + 1))
    outside = 1 - float(last - first) / len(events)
    if outside > OUTSIDE:
        severity = "error" if capture.frames is None or outside > OUTSIDE_ERROR else "warning"
        checkup.add(
            severity,
            "poses-missing",
            f"{outside:.0%} of the events are outside the time of the poses",
            got=f"poses from {known[0]} to {known[1]} us, events from {events.t_us[0]} to"
            f" {events.t_us[-1]} us",
            do="complete the trajectory, or cut the recording to it",
        )
    return outside <= OUTSIDE


def check_hold_out(capture: Capture, checkup: Checkup) -> None:
    """Whether sharp frames are held out for evaluation."""
    frames, test = capture.frames, capture.split.test
    if frames is None:
        return
    if not len(test):
        checkup.add(
            "note",
            "hold-out",
            "no frame is held out, so held-out views cannot be scored",
            do="hold frames out with --hold-out every:8",
        )
        return
    blurred = ~frames.exposure.instant[test] & ~frames.with_truth[test]
    if blurred.any():
        checkup.add(
            "warning",
            "hold-out",
            f"{blurred.sum()} of {len(test)} held-out frames are blurred, so metrics will favour"
            " blurred renders",
            do="hold out sharp frames: those with the shortest exposure",
        )
    else:
        checkup.add("note", "hold-out", f"{len(test)} sharp frames are held out")
