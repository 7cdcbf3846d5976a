"""Checks of each sensor by itself: event rate, dead and hot pixels, over- and underexposure."""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import nn

from sharpfield.core.capture import Capture
from sharpfield.core.events import EventStream
from sharpfield.preparation.doctor.findings import Checkup

AROUND = 7
"""Side of the neighbourhood that a pixel is compared with, in px."""
HOT_TIMES = 8.0
"""A hot pixel has so many times the events of the median of its neighbourhood,"""
HOT_SIGMA = 8.0
"""and exceeds it by so many standard deviations of a Poisson count."""
DEAD_MEDIAN = 30.0
"""A pixel without events is dead where the median of its neighbourhood is at least this."""


def counts(events: EventStream) -> Int64[np.ndarray, "h w"]:
    """Number of events of each pixel; rectified positions count for the nearest one."""
    x = np.clip(np.rint(events.x).astype(np.int64), 0, events.width - 1)
    y = np.clip(np.rint(events.y).astype(np.int64), 0, events.height - 1)
    flat = np.bincount(y * events.width + x, minlength=events.width * events.height)
    return flat.reshape(events.height, events.width)


def odd_pixels(
    count: Int64[np.ndarray, "h w"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Dead and hot pixels, by their event counts."""
    median = _median_around(count)
    hot = (count > HOT_TIMES * (median + 1)) & (count > median + HOT_SIGMA * np.sqrt(median + 1))
    return (count == 0) & (median >= DEAD_MEDIAN), hot


def _median_around(count: Int64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    reach = AROUND // 2
    padded = nn.functional.pad(
        torch.from_numpy(count).double()[None, None], (reach,) * 4, mode="replicate"
    )
    windows = padded.unfold(2, AROUND, 1).unfold(3, AROUND, 1)  # [1, 1, h, w, 7, 7]
    return windows.flatten(-2).median(-1).values[0, 0].numpy()


WINDOW_US = 1000
"""Windows in which events are counted to find the readout limit."""
LIMIT_PERCENTILE = 99
"""Percentile of the counts of windows that estimates the readout limit."""
AT_LIMIT, BELOW_LIMIT = 0.97, 0.85
"""A saturated sensor has many windows above `AT_LIMIT` times the limit:"""
MIN_SHARE, MIN_RATIO = 0.08, 2.0
"""at least this share of the windows with events, and so many times as many as between
`BELOW_LIMIT` and `AT_LIMIT`;"""
SATURATED_SHARE = 0.3
"""or this share anyway: a swinging camera, slowest at its turning points, reaches half of it."""
MIN_EVENTS = 20
"""Fewer events in the busiest window do not show a limit."""
ODD_SHARE = 1e-3
"""Share of dead or hot pixels that is a warning."""
WHITE, BLACK = 0.995, 0.004
"""Values from which on a pixel counts as white, and up to which as black."""
CLIPPED, CLIPPED_BADLY, DARK = 0.05, 0.25, 0.5
"""Shares of white pixels that are a warning and an error; share of black ones for a warning."""


def check_layout(capture: Capture, checkup: Checkup) -> bool:
    """Whether event positions are in the pixel grid of the frames."""
    events, (width, height) = capture.events, capture.camera.size
    if events is None or not len(events):
        if events is not None:
            checkup.add("error", "no-events", "the event stream is empty")
        return False
    reach = float(np.max(events.x)), float(np.max(events.y))
    got = f"x up to {reach[0]:g}, y up to {reach[1]:g}; frames are {width}x{height}"
    swapped = (events.width, events.height) == (height, width) and width != height
    beyond = not events.rectified and (reach[0] >= events.width or reach[1] >= events.height)
    if swapped or (beyond and reach[0] < height and reach[1] < width):
        checkup.add(
            "error", "axes-swapped", "x and y of the events are swapped", got=got,
            do="ingest again with --swap-xy",
        )  # fmt: skip
        return False
    if beyond or (events.width, events.height) != (width, height):
        checkup.add(
            "error",
            "sizes",
            "events and frames have different resolutions",
            got=f"{got}; the event sensor is {events.width}x{events.height}",
            do="ingest with the calibration of both cameras, so that one is warped to the other",
        )
        return False
    return True


def check_rate(capture: Capture, checkup: Checkup) -> None:
    """Event rate, and whether the readout of the sensor was saturated."""
    events = capture.needed_events
    seconds = max(int(events.t_us[-1] - events.t_us[0]), 1) / 1e6
    counts = _events_per_window(events)
    brighter = float(np.mean(np.asarray(events.p) > 0))
    checkup.add(
        "note",
        "event-rate",
        f"{len(events):,} events in {seconds:.3g} s: {len(events) / seconds / 1e6:.3g} M/s on"
        f" average, {counts.max() / WINDOW_US:.3g} M/s at most, {brighter:.0%} to brighter",
    )
    if not 0.1 < brighter < 0.9:
        checkup.add(
            "error",
            "one-sign",
            "nearly all events have the same polarity",
            got=f"{brighter:.1%} to brighter",
            do="check how polarity is stored: 0 and 1, or -1 and +1",
        )
    active = counts[counts > 0]
    limit = float(np.percentile(active, LIMIT_PERCENTILE)) if len(active) else 0.0
    share = float((active >= AT_LIMIT * limit).mean())
    below = float(((active >= BELOW_LIMIT * limit) & (active < AT_LIMIT * limit)).mean())
    saturated = share > SATURATED_SHARE or share > max(MIN_SHARE, MIN_RATIO * below)
    if limit >= MIN_EVENTS and saturated:
        checkup.add(
            "error",
            "events-saturated",
            "the readout of the event sensor was saturated, and events were lost",
            got=f"{share:.0%} of the milliseconds have at least {AT_LIMIT * limit:.0f} events,"
            f" {below:.0%} slightly fewer",
            do="raise the thresholds, move slower, or read out a part of the sensor; brightness"
            " cannot be reconstructed from such a recording",
        )


def check_pixels(capture: Capture, checkup: Checkup) -> None:
    """Dead and hot pixels."""
    count = counts(capture.needed_events)
    dead, hot = odd_pixels(count)
    for name, odd, do in (
        ("dead-pixels", dead, "they report no events; `sharpfield calibrate` maps them"),
        ("hot-pixels", hot, "ingest with the hot-pixel filter, or mask them"),
    ):
        share = float(odd.mean())
        severity = "warning" if share > ODD_SHARE else "note"
        positions = ", ".join(f"({x}, {y})" for y, x in np.argwhere(odd)[:6])
        checkup.add(
            severity,
            name,
            f"{odd.sum()} {name.replace('-', ' ')} of {odd.size:,}",
            got=f"at {positions}{', ...' if odd.sum() > 6 else ''}" if odd.any() else "",
            do=do if odd.any() else "",
        )
    level = np.log1p(count) / max(np.log1p(np.percentile(count, 99.5)), 1e-9)
    shown = np.repeat((255 * np.clip(level, 0, 1)).astype(np.uint8)[..., None], 3, -1)
    shown[dead], shown[hot] = (38, 86, 190), (245, 160, 40)
    checkup.images["events of each pixel (log scale): dead pixels blue, hot ones amber"] = shown


def check_light(capture: Capture, checkup: Checkup) -> None:
    """Whether frames are over- or underexposed."""
    frames = capture.needed_frames
    white = np.mean(frames.images >= WHITE * frames.white)
    black = np.mean(frames.images <= BLACK * frames.white)
    # Rendered objects are composited on white.
    if white > CLIPPED and capture.known.background != "white":
        checkup.add(
            "error" if white > CLIPPED_BADLY else "warning",
            "frames-saturated",
            "large parts of the frames are overexposed",
            got=f"{white:.0%} of all values",
            do="shorten the exposure or close the aperture; mask white areas",
        )
    if black > DARK:
        checkup.add(
            "warning",
            "frames-dark",
            "most of the frames is underexposed",
            got=f"{black:.0%} of all values",
            do="lengthen the exposure, or light the scene",
        )


def _events_per_window(events: EventStream) -> Int64[np.ndarray, "k"]:
    """Number of events in each whole millisecond."""
    edges = np.arange(int(events.t_us[0]), int(events.t_us[-1]) + 1, WINDOW_US)
    if len(edges) < 2:
        return np.array([len(events)], np.int64)
    return np.diff(np.searchsorted(events.t_us, edges))
