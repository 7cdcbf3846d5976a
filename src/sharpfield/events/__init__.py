"""Arithmetic on streams of events: counts, images of events, log light, sharp images from blur."""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.core.events import EventStream as EventStream
    from sharpfield.events.counts import EventMotion as EventMotion
    from sharpfield.events.double_integral import edi as edi
    from sharpfield.events.image import window_image as window_image
    from sharpfield.events.threshold import FixedThresholds as FixedThresholds

__getattr__, __dir__ = lazily(__name__, __file__, check_shapes=True)
