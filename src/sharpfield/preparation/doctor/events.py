"""Checks of the two sensors by themselves: rates, saturation, dead and hot pixels, light.

Pixels of an event camera that do nothing, and pixels that never stop.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import nn

from sharpfield.core.capture import Capture
from sharpfield.core.events import EventStream
from sharpfield.preparation.doctor.findings import Checkup

AROUND = 7
"""Side of the neighbourhood a pixel is compared with."""
HOT_TIMES = 8.0
"""A hot pixel reports so many times as often as the median of its neighbourhood,"""
HOT_SIGMA = 8.0
"""and so many standard deviations (of counting) more."""
BUSY = 30.0
"""A silent pixel is dead where the median of its neighbourhood is at least so many events."""


def counts(events: EventStream) -> Int64[np.ndarray, "h w"]:
    """Events of each pixel; rectified positions count for the nearest."""
    x = np.clip(np.rint(events.x).astype(np.int64), 0, events.width - 1)
    y = np.clip(np.rint(events.y).astype(np.int64), 0, events.height - 1)
    flat = np.bincount(y * events.width + x, minlength=events.width * events.height)
    return flat.reshape(events.height, events.width)


def odd_pixels(
    count: Int64[np.ndarray, "h w"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Dead and hot pixels, by their counts of events."""
    usual = _median_around(count)
    hot = (count > HOT_TIMES * (usual + 1)) & (count > usual + HOT_SIGMA * np.sqrt(usual + 1))
    return (count == 0) & (usual >= BUSY), hot


def _median_around(count: Int64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    reach = AROUND // 2
    padded = nn.functional.pad(
        torch.from_numpy(count).double()[None, None], (reach,) * 4, mode="replicate"
    )
    windows = padded.unfold(2, AROUND, 1).unfold(3, AROUND, 1)
    return windows.flatten(-2).median(-1).values[0, 0].numpy()


WINDOW_US = 1000
USUAL_MOST = 99
"""Percentile of windows that tells the limit; single ones may exceed it."""
TOP, BELOW = 0.97, 0.85
"""A sensor at its limit piles up windows above `TOP` of that,"""
PILED, STEEP = 0.08, 2.0
"""this share of those with events, and so many times as many as between `BELOW` and `TOP`."""
CROWDED = 0.3
"""Or this share, whatever is below: even a swing, slowest where it turns, stays at half of it."""
LEAST_WINDOW = 20
"""Events in the busiest window; fewer say nothing of a limit."""
ODD_SHARE = 1e-3
"""Share of dead or hot pixels that is worth mending."""
WHITE, BLACK = 0.995, 0.004
CLIPPED, CLIPPED_BADLY, DARK = 0.05, 0.25, 0.5
"""Shares of pixels that are white or black."""


def check_layout(capture: Capture, checkup: Checkup) -> bool:
    """Whether events lie on the pixels of the frames."""
    events, (width, height) = capture.events, capture.camera.size
    if events is None or not len(events):
        if events is not None:
            checkup.say("error", "no-events", "the stream of events is empty")
        return False
    reach = float(np.max(events.x)), float(np.max(events.y))
    got = f"x up to {reach[0]:g}, y up to {reach[1]:g}; frames are {width}x{height}"
    swapped = (events.width, events.height) == (height, width) and width != height
    beyond = not events.rectified and (reach[0] >= events.width or reach[1] >= events.height)
    if swapped or (beyond and reach[0] < height and reach[1] < width):
        checkup.say(
            "error", "axes-swapped", "x and y of the events are exchanged", got=got,
            do="ingest again with --swap-xy",
        )  # fmt: skip
        return False
    if beyond or (events.width, events.height) != (width, height):
        checkup.say(
            "error",
            "sizes",
            "events and frames are not of the same pixels",
            got=f"{got}; the event sensor says {events.width}x{events.height}",
            do="ingest with the calibration of both cameras, so that one is warped to the other",
        )
        return False
    return True


def check_rate(capture: Capture, checkup: Checkup) -> None:
    """How fast events came, and whether the sensor kept up."""
    events = capture.needed_events
    seconds = max(int(events.t_us[-1] - events.t_us[0]), 1) / 1e6
    window = _windows(events)
    brighter = float(np.mean(np.asarray(events.p) > 0))
    checkup.say(
        "note",
        "event-rate",
        f"{len(events):,} events in {seconds:.3g} s: {len(events) / seconds / 1e6:.3g} M/s on"
        f" average, {window.max() / WINDOW_US:.3g} M/s at most, {brighter:.0%} to brighter",
    )
    if not 0.1 < brighter < 0.9:
        checkup.say(
            "error",
            "one-sign",
            "nearly all events have one sign",
            got=f"{brighter:.1%} to brighter",
            do="check how polarity is stored: 0 and 1, or -1 and +1",
        )
    busy = window[window > 0]
    most = float(np.percentile(busy, USUAL_MOST)) if len(busy) else 0.0
    piled = float((busy >= TOP * most).mean())
    below = float(((busy >= BELOW * most) & (busy < TOP * most)).mean())
    if most >= LEAST_WINDOW and (piled > CROWDED or piled > max(PILED, STEEP * below)):
        checkup.say(
            "error",
            "events-saturated",
            "the event sensor was at the limit of its readout, and lost events",
            got=f"{piled:.0%} of the milliseconds have {TOP * most:.0f} events or a few more,"
            f" {below:.0%} a little fewer",
            do="raise the thresholds, move slower, or read out a part of the sensor; such a"
            " recording cannot say how bright things were",
        )


def check_pixels(capture: Capture, checkup: Checkup) -> None:
    """Dead and hot pixels."""
    count = counts(capture.needed_events)
    dead, hot = odd_pixels(count)
    for name, odd, do in (
        ("dead-pixels", dead, "they say nothing; `sharpfield calibrate` maps them"),
        ("hot-pixels", hot, "ingest with the hot-pixel filter, or mask them"),
    ):
        share = float(odd.mean())
        severity = "warning" if share > ODD_SHARE else "note"
        places = ", ".join(f"({x}, {y})" for y, x in np.argwhere(odd)[:6])
        checkup.say(
            severity,
            name,
            f"{odd.sum()} {name.replace('-', ' ')} of {odd.size:,}",
            got=f"at {places}{', ...' if odd.sum() > 6 else ''}" if odd.any() else "",
            do=do if odd.any() else "",
        )
    level = np.log1p(count) / max(np.log1p(np.percentile(count, 99.5)), 1e-9)
    shown = np.repeat((255 * np.clip(level, 0, 1)).astype(np.uint8)[..., None], 3, -1)
    shown[dead], shown[hot] = (38, 86, 190), (245, 160, 40)
    checkup.images["events of each pixel (log): dead ones blue, hot ones amber"] = shown


def check_light(capture: Capture, checkup: Checkup) -> None:
    """Whether frames are too bright or too dark to be inverted."""
    frames = capture.needed_frames
    white = np.mean(frames.images >= WHITE * frames.white)
    black = np.mean(frames.images <= BLACK * frames.white)
    # Rendered objects are laid on white.
    if white > CLIPPED and capture.known.background != "white":
        checkup.say(
            "error" if white > CLIPPED_BADLY else "warning",
            "frames-saturated",
            "much of the frames is white: what was there is lost",
            got=f"{white:.0%} of all values",
            do="shorten the exposure or close the aperture; mask what is white",
        )
    if black > DARK:
        checkup.say(
            "warning",
            "frames-dark",
            "most of the frames is black",
            got=f"{black:.0%} of all values",
            do="lengthen the exposure, or light the scene",
        )


def _windows(events: EventStream) -> Int64[np.ndarray, "k"]:
    """Events in each whole millisecond."""
    edges = np.arange(int(events.t_us[0]), int(events.t_us[-1]) + 1, WINDOW_US)
    if len(edges) < 2:
        return np.array([len(events)], np.int64)
    return np.diff(np.searchsorted(events.t_us, edges))
