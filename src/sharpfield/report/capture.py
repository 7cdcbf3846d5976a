"""The part of the report that shows what was captured."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.report import page
from sharpfield.report.colormaps import as_display, eight_bit, event_image
from sharpfield.report.figures import TEST, TRAIN, timeline_figure, trajectory_figure
from sharpfield.report.page import Image, Look, section

STRIP = 3
"""Frames shown beside the events."""
STRIP_PX = 560
EVENTS_US = 20_000
"""Length of the window whose events are shown."""


def captured(capture: Capture, look: Look) -> str:
    """Counts, a few recorded frames, an event image, the camera's path, the timeline."""
    keys = (
        f'<p class="keys"><span class="key" style="--of:{TRAIN}">training frames</span>'
        f'<span class="key" style="--of:{TEST}">held out</span></p>'
    )
    small = Look(min(look.longest_px, STRIP_PX), look.quality)
    strip = "".join(page.figure(image, small) for image in _strip(capture))
    return section(
        "What was captured",
        page.definitions(_counts(capture)),
        f'<div class="row">{strip}</div>' if strip else "",
        keys if capture.frames is not None else "",
        page.drawing(
            trajectory_figure(capture),
            "Path of the camera: thick where the shutter was open, ticks where it looked.",
        ),
        page.drawing(
            timeline_figure(capture),
            "When the shutter was open (bars), and how fast events came (grey).",
        ),
    )


def _counts(capture: Capture) -> dict[str, object]:
    frames, events = capture.frames, capture.events
    counts: dict[str, object] = {"capture": capture.name}
    if capture.source:
        counts["layout"] = capture.source
    if frames is not None:
        counts["frames"] = (
            f"{len(frames)} of {frames.width}×{frames.height} px: {len(capture.split.train)} to"
            f" train, {len(capture.split.test)} held out; stored as {frames.encoding}"
        )
        lasting = frames.exposure.duration_us[~frames.exposure.instant] / 1000
        if len(lasting):
            counts["exposure"] = f"{len(lasting)} frames of {_span(lasting)} ms"
        elif capture.known.motion == "unknown":
            counts["exposure"] = "unknown; the photos may be blurred by unknown motion"
    if events is not None and len(events):
        seconds = max(float(events.t_us[-1] - events.t_us[0]) / 1e6, 1e-6)
        counts["events"] = (
            f"{len(events):,} in {seconds:.3g} s ({len(events) / seconds / 1e6:.2f} M/s),"
            f" {np.mean(events.p > 0):.0%} to brighter,"
            f" {'coloured' if events.coloured else 'without colour'}"
        )
    return counts


def _strip(capture: Capture) -> list[Image]:
    """Some recorded training frames, and after the first its camera's events around its middle."""
    frames, events = capture.frames, capture.events
    images, middle_us, camera = [], None, 0
    for i in evenly_spread(capture.split.train, STRIP) if frames is not None else []:
        assert frames is not None
        duration = frames.exposure.duration_us[i] / 1000
        caption = f"frame {frames.names[i]}" + (f", {duration:g} ms" if duration else "")
        pixels = eight_bit(as_display(frames.images[i]).numpy())
        images.append(Image("frame", pixels, caption, f"Recorded {caption}"))
        if middle_us is None:
            middle_us, camera = int(frames.exposure.middle_us[i]), int(frames.track[i])
    if events is not None and len(events):
        if middle_us is None:
            middle_us = int(events.t_us[0] + events.t_us[-1]) // 2
        seen = events if events.track is None else events.of_track(camera)
        pixels = event_image(seen, middle_us - EVENTS_US // 2, middle_us + EVENTS_US // 2)
        caption = f"events of {EVENTS_US / 1000:g} ms: red brighter, blue darker"
        images.insert(1, Image("events", pixels, caption, f"E{caption[1:]}"))
    return images


def _span(values: Shaped[np.ndarray, "n"] | Sequence[float]) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
