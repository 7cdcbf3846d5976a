"""Numbers of events of each pixel between two times, and events aligned to a rolling shutter.

With a rolling shutter each row of a frame opens and closes a little later than the one above. If
the events of each row are shifted in time by that delay, all rows are exposed at the same time, and
code that compares frames and events of a pixel works as for a global shutter.

`EventMotion` is the change of log light of a capture, from its events: over an exposure or between
two times. `site_channels` says which colour filter lies before each site of an event camera.
"""

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int8, Int64
from numba import njit
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.events.index import EventIndex, build_index, sites_at
from sharpfield.events.log_path import (
    LogPath,
    Spread,
    change_between,
    exposure_path,
    pixel_spread,
    site_spread,
)
from sharpfield.events.sites import find_sites, parts
from sharpfield.events.threshold import FixedThresholds

CHANNELS = {"R": 0, "G": 1, "B": 2}


def site_channels(events: EventStream, index: EventIndex) -> Int8[np.ndarray, "m"] | None:
    """0 red, 1 green or 2 blue for each site of the index; None on a mono sensor.

    Raises:
        CaptureError: The tile is not known, a site that fires has no colour, or has two.
    """
    if events.site_colour is not None:
        return _looked_up(events, index)
    if events.bayer:
        return _tiled(events, index)
    return None


def _tiled(events: EventStream, index: EventIndex) -> Int8[np.ndarray, "m"]:
    if len(events.bayer) != 4 or not set(events.bayer) <= CHANNELS.keys() or events.rectified:
        raise CaptureError(
            "a colour filter tile is four letters, and for integer coordinates only",
            got=f"{events.bayer!r}, {'rectified' if events.rectified else 'integer'} coordinates",
            do="e.g. RGGB; give rectified positions their colours one by one",
        )
    tile = np.array([CHANNELS[letter] for letter in events.bayer], np.int8)
    column, row = index.site_xy.astype(np.int64).T
    return tile[2 * (row % 2) + column % 2]


def _looked_up(events: EventStream, index: EventIndex) -> Int8[np.ndarray, "m"]:
    known = events.site_colour
    assert known is not None, "only called where colours are given"
    site = sites_at(index, np.stack([known.x, known.y], -1).astype(np.float32))
    found = site >= 0
    channel = np.full(index.sites, -1, np.int8)
    channel[site[found]] = known.channel[found]
    twice = found & (channel[site] != known.channel)
    silent = np.diff(index.offset) == 0
    unknown = np.flatnonzero((channel < 0) & ~silent)
    if twice.any() or len(unknown):
        what = "has two colours" if twice.any() else "has no colour"
        x, y = index.site_xy[site[twice][0] if twice.any() else unknown[0]]
        raise CaptureError(
            f"a pixel of the event camera {what}",
            where=f"rectified position ({x}, {y})",
            got=f"{int(twice.sum())} with two, {len(unknown)} without, of {index.sites}",
            do="the map of rectified positions must hold exactly the positions of the events",
        )
    return np.maximum(channel, 0)


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


TINY = 1e-9
"""A threshold so small that events of its sign do not count."""


def counts_between(
    motion: EventMotion, start_us: int, end_us: int
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w c"]]:
    """Minus the number of OFF events, and the number of ON events, with start < t <= end.

    Whole numbers on a mono sensor with integer coordinates. For rectified positions and pixels
    behind a colour filter they are interpolated as in `events.log_path`, with c = 3 for colours.

    Args:
        motion: The events.
        start_us: Not after the end.
        end_us: Included.
    """
    events = motion.events
    if motion.channel is None and not events.rectified:
        first, last = np.searchsorted(events.t_us, (start_us, end_us), side="right")
        counts = np.zeros((2, events.height, events.width, 1), np.float32)
        part = slice(int(first), int(last))
        _count(events.x[part], events.y[part], events.p[part], counts)
        return torch.as_tensor(-counts[0]), torch.as_tensor(counts[1])
    window, channel = (start_us, end_us), motion.channel
    negative, positive = (
        change_between(events, window, only, motion.spread, channel=channel)
        for only in (FixedThresholds(1.0, TINY), FixedThresholds(TINY, 1.0))
    )
    return negative, positive


@njit(cache=True, nogil=True)
@no_type_check
def _count(x, y, p, counts):
    for i in range(len(x)):
        counts[1 if p[i] > 0 else 0, y[i], x[i], 0] += 1


def subtract_row_delay(events: EventStream, row_delay_us: float) -> EventStream:
    """The same events, each earlier by the readout delay of its row, sorted by these times.

    Args:
        events: Of the same pixels as the frames.
        row_delay_us: Readout delay from one row to the next.
    """
    if row_delay_us == 0 or not len(events):
        return events
    late = np.rint(np.asarray(events.y, np.float64) * row_delay_us).astype(np.int64)
    t_us = np.asarray(events.t_us) - late
    return replace(events, t_us=t_us)[np.argsort(t_us, kind="stable")]
