"""The section of a page that shows what was captured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.report.colormaps import as_display, eight_bit, event_image
from sharpfield.report.figures import TEST, TRAIN, timeline_figure, trajectory_figure
from sharpfield.report.page import CaptionedImage

FRAMES = 3
"""Recorded frames shown beside the events."""
EVENTS_US = 20_000
"""Length of the window whose events are shown."""


@dataclass(frozen=True)
class CaptureSection:
    """The values of the template macro `capture_section`."""

    counts: dict[str, object]
    """Frames, exposures, events, in words."""
    images: list[CaptionedImage]
    """A few training frames, and the events around the middle of the first."""
    colours: dict[str, str]
    """Colours of the drawings by meaning; empty without frames."""
    trajectory: str
    """SVG."""
    timeline: str | None
    """SVG; None where the times of the frames are made up."""


def capture_section(capture: Capture) -> CaptureSection:
    """Counts, a few recorded frames, an event image, the camera path and the timeline."""
    colours = {"training frames": TRAIN, "held out": TEST}
    return CaptureSection(
        counts=_counts(capture),
        images=_images(capture),
        colours=colours if capture.frames is not None else {},
        trajectory=trajectory_figure(capture),
        timeline=timeline_figure(capture),
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
        exposures_ms = frames.exposure.duration_us[~frames.exposure.instant] / 1000
        if len(exposures_ms):
            counts["exposure"] = f"{len(exposures_ms)} frames of {_range(exposures_ms)} ms"
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


def _images(capture: Capture) -> list[CaptionedImage]:
    """Some training frames, and after the first the events of its camera around its middle."""
    frames, events = capture.frames, capture.events
    images, middle_us, camera = [], None, 0
    for i in evenly_spread(capture.split.train, FRAMES) if frames is not None else []:
        assert frames is not None
        exposure_ms = frames.exposure.duration_us[i] / 1000
        caption = f"frame {frames.names[i]}" + (f", {exposure_ms:g} ms" if exposure_ms else "")
        pixels = eight_bit(as_display(frames.images[i]).numpy())
        images.append(CaptionedImage("frame", pixels, caption, f"Recorded {caption}"))
        if middle_us is None:
            middle_us, camera = int(frames.exposure.middle_us[i]), int(frames.track[i])
    if events is not None and len(events):
        if middle_us is None:
            middle_us = int(events.t_us[0] + events.t_us[-1]) // 2
        own = events if events.track is None else events.of_track(camera)
        pixels = event_image(own, middle_us - EVENTS_US // 2, middle_us + EVENTS_US // 2)
        caption = f"events of {EVENTS_US / 1000:g} ms: red brighter, blue darker"
        images.insert(1, CaptionedImage("events", pixels, caption, f"E{caption[1:]}"))
    return images


def _range(values: Shaped[np.ndarray, "n"] | Sequence[float]) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
