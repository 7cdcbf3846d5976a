"""The change of log light of a capture, from its events: over an exposure or between two times."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int8, Int64
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.events.index import build_index
from sharpfield.events.log_path import (
    LogPath,
    Spread,
    change_between,
    exposure_path,
    pixel_spread,
    site_spread,
)
from sharpfield.events.site_colour import site_channels
from sharpfield.events.sites import find_sites, parts
from sharpfield.events.threshold import FixedThresholds


@dataclass(frozen=True)
class EventMotion:
    """The events of a capture, and how they act on the pixels of its frames."""

    events: EventStream
    spread: Spread
    channel: Int8[np.ndarray, "n"] | None
    """Colour of each event; None on a mono sensor."""

    @classmethod
    def of(cls, capture: Capture) -> "EventMotion":
        """From the events of a capture.

        Raises:
            CaptureError: There are no events, they and the frames differ in size, or they come
                from several cameras.
        """
        events, camera = capture.needed_events, capture.camera
        if events.tracks > 1:
            raise CaptureError(
                "deblurring needs the events of one camera",
                where=capture.name,
                got=f"events of {events.tracks} cameras",
                do="train a recipe for rigs: ev-dynamic-splat, evdnerf-physical, evdnerf, d-nerf;"
                " or leave the events out (--use frames)",
            )
        if (events.width, events.height) != camera.size:
            raise CaptureError(
                "deblurring needs events and frames of the same pixels",
                where=capture.name,
                got=f"events {events.width}x{events.height}, frames {camera.width}x{camera.height}",
                do="warp one to the other first",
            )
        size = {"width": events.width, "height": events.height}
        if not events.coloured:
            return cls(events, pixel_spread(**size), None)
        if (known := events.site_colour) is not None:
            xy = np.stack([known.x, known.y], -1).astype(np.float32)
            return cls(events, site_spread(xy, known.channel, **size), _channels(events))
        index = build_index(events[:0])  # every pixel is a site
        colours = site_channels(events, index)
        return cls(events, site_spread(index.site_xy, colours, **size), _channels(events))

    def path(
        self,
        window_us: tuple[int, int],
        instants_us: Int64[np.ndarray, "k"],
        thresholds: FixedThresholds,
    ) -> LogPath:
        """Over one exposure, see `formation.log_path.exposure_path`."""
        return exposure_path(
            self.events, window_us, instants_us, thresholds, self.spread, channel=self.channel
        )

    def between(
        self, start_us: int, end_us: int, thresholds: FixedThresholds
    ) -> Float[Tensor, "h w c"]:
        """Change of log light between two times."""
        return change_between(
            self.events, (start_us, end_us), thresholds, self.spread, channel=self.channel
        )


def _channels(events: EventStream) -> Int8[np.ndarray, "n"]:
    """The colour of each event, by the colour of its site."""
    _, site_of = find_sites(events)
    channel = site_channels(events, build_index(events))
    assert channel is not None, "only called for coloured events"
    return np.concatenate([channel[site_of(part)] for part in parts(events)] or [channel[:0]])
