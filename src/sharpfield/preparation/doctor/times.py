"""Checks of clocks: units, what covers what, exposures, the frames that are held out."""

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.geometry.trajectory import Stamped, Tracks
from sharpfield.preparation.doctor.findings import Checkup
from sharpfield.storage.event_file import THOUSAND

SHORTEST_US, LONGEST_US = 20, 2_000_000
"""Exposures that cameras have; others are probably in another unit."""
SLOW_S = 20.0
"""Seconds from frame to frame, beyond which a recording with events is probably in another unit."""
GAP_TIMES, GAP_US = 6.0, 30_000
"""A gap between poses is a hole if it is so many times the usual one, and so long."""
OUTSIDE = 0.1
"""Share of events without a pose that is worth a word."""


def check_units(capture: Capture, checkup: Checkup) -> bool:
    """Whether times of frames, events and poses are in one unit and overlap; says so if not."""
    frames, events = capture.frames, capture.events
    if frames is None or events is None or not len(events):
        return True
    if capture.known.motion == "unknown":
        checkup.say("note", "times", "frames have made-up times, so events cannot be compared")
        return False
    spans = {
        "events": (int(events.t_us[0]), int(events.t_us[-1])),
        "frames": (int(frames.exposure.open_us.min()), int(frames.exposure.close_us.max())),
    }
    lasts = {name: max(last - first, 1) for name, (first, last) in spans.items()}
    got = ", ".join(f"{name} from {a} to {b} us" for name, (a, b) in spans.items())
    ratio = lasts["events"] / lasts["frames"]
    if len(frames) > 1:
        for larger, factor in (("event", ratio), ("frame", 1 / ratio)):
            if THOUSAND[0] < factor < THOUSAND[1]:
                checkup.say(
                    "error",
                    "time-unit",
                    f"{larger} times look like ns that were taken for us",
                    got=f"{got}: a factor of {factor:.0f}",
                    do=f"divide the {larger} times by 1000, or ingest again with unit ns",
                )
                return False
    common = min(spans["events"][1], spans["frames"][1]) - max(
        spans["events"][0], spans["frames"][0]
    )
    if common < 0:
        checkup.say(
            "error",
            "no-overlap",
            "frames and events were not taken at the same time",
            got=got,
            do="check that both clocks count from the same instant",
        )
        return False
    return _plausible(capture, checkup)


def _plausible(capture: Capture, checkup: Checkup) -> bool:
    """Whether intervals, exposures and coverage by events are those of cameras."""
    exposure, events = capture.needed_frames.exposure, capture.needed_events
    apart = np.diff(np.sort(exposure.open_us))
    if len(apart) and np.median(apart) > 1e6 * SLOW_S:
        checkup.say(
            "error",
            "time-unit",
            "all times look like ns that were taken for us",
            got=f"{np.median(apart) / 1e6:.0f} s from frame to frame",
            do="divide all times by 1000, or ingest again with unit ns",
        )
        return False
    lasting = exposure.duration_us[~exposure.instant]
    outside = (exposure.open_us < events.t_us[0]) | (exposure.close_us > events.t_us[-1])
    if outside.any():
        checkup.say(
            "warning",
            "coverage",
            f"{outside.sum()} of {len(exposure)} exposures are not covered by events",
            got=f"frames {', '.join(map(str, np.flatnonzero(outside)[:8]))}",
            do="cut the recording to the time that both cameras ran",
        )
    if len(lasting) and not SHORTEST_US <= np.median(lasting) <= LONGEST_US:
        checkup.say(
            "error",
            "exposure-unit",
            "exposures are longer or shorter than those of cameras",
            got=f"median {np.median(lasting):.0f} us",
            do="give exposure times in us",
        )
    elif len(lasting):
        share = np.median(lasting) / max(float(np.median(apart)) if len(apart) else 1, 1)
        checkup.say(
            "note",
            "exposure",
            f"{len(lasting)} frames are exposed for {np.median(lasting) / 1000:.1f} ms,"
            f" {share:.0%} of the interval between frames",
        )
    else:
        checkup.say("note", "exposure", "no frame has an exposure: all are taken for sharp")
    return True


def check_poses_known(capture: Capture, checkup: Checkup) -> bool:
    """Whether there are poses, without holes, for all that was recorded."""
    if capture.known.poses == "unknown":
        checkup.say(
            "warning",
            "poses-unknown",
            "nobody knows yet where the camera was",
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
            checkup.say(
                "error",
                "poses-missing",
                f"the trajectory of track {number} has a hole",
                got=f"no pose from {one.times_us[worst]} to {one.times_us[worst + 1]} us; they"
                f" usually are {np.median(apart):.0f} us apart",
                do="complete the trajectory, find poses anew with `sharpfield poses`, or cut the"
                " recording there",
            )
    return _events_posed(capture, checkup) and sound


def _events_posed(capture: Capture, checkup: Checkup) -> bool:
    """Whether the poses reach over the events."""
    events = capture.events
    known = capture.trajectory.known_us(0)
    if events is None or known is None or not len(events):
        return True
    first, last = np.searchsorted(events.t_us, (known[0], known[1] + 1))
    outside = 1 - float(last - first) / len(events)
    if outside > OUTSIDE:
        severity = "error" if capture.frames is None or outside > 0.3 else "warning"
        checkup.say(
            severity,
            "poses-missing",
            f"{outside:.0%} of the events happened where no pose is known",
            got=f"poses from {known[0]} to {known[1]} us, events from {events.t_us[0]} to"
            f" {events.t_us[-1]} us",
            do="complete the trajectory, or cut the recording to it",
        )
    return outside <= OUTSIDE


def check_hold_out(capture: Capture, checkup: Checkup) -> None:
    """Whether there is something to be scored on."""
    frames, test = capture.frames, capture.split.test
    if frames is None:
        return
    if not len(test):
        checkup.say(
            "note",
            "hold-out",
            "no frame is held out, so nothing can be scored",
            do="hold frames out with --hold-out every:8",
        )
        return
    blurred = ~frames.exposure.instant[test] & ~frames.with_truth[test]
    if blurred.any():
        checkup.say(
            "warning",
            "hold-out",
            f"{blurred.sum()} of {len(test)} held-out frames are blurred, so scores will favour"
            " blur",
            do="hold out sharp frames: those with the shortest exposure",
        )
    else:
        checkup.say("note", "hold-out", f"{len(test)} sharp frames are held out")
