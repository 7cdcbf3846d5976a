"""Which colour filter lies before each site of an event camera."""

import numpy as np
from jaxtyping import Int8

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.events.index import EventIndex, sites_at

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
