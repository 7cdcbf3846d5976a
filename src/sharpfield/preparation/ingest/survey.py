"""First pass over the events of a recording, hot pixels, and event filters.

A *hot pixel* fires all the time, whatever it sees. It is detected by comparison: an edge that moves
over a pixel also moves over its neighbours, so no working pixel has many times the events of nearly
all of the 24 pixels around it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Int64
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Chunks

MS = 1000
MAX_SPAN_US = 24 * 3600 * 1_000_000
"""A recording longer than a day means that the time unit is wrong."""

MIN_EVENTS = 20
"""Fewest events of a hot pixel."""
RADIUS, RANK = 2, 20
"""A pixel is compared with the pixel of this rank, by event count, among the 25 within this radius:
a thin line, or two hot pixels side by side, may be among the others."""


@dataclass(frozen=True)
class Survey:
    """Result of the first pass."""

    count: int
    first_us: int
    last_us: int
    """Times of the first and the last event; both 0 if there are none."""
    events_per_pixel: Int64[np.ndarray, "h w"]
    """Number of events of each pixel."""
    events_per_ms: Int64[np.ndarray, "m"]
    """Number of events in each ms, from that of the first event."""

    @property
    def origin_us(self) -> int:
        """Begin of `events_per_ms`, a whole ms."""
        return self.first_us // MS * MS


def survey_events(
    chunks: Chunks, size: tuple[int, int], where: object, progress: Callable[[int], None]
) -> Survey:
    """Count all events of a sensor of some width and height, in bounded memory.

    Raises:
        CaptureError: The recording is longer than a day.
    """
    events_per_pixel = np.zeros(size[::-1], np.int64)
    events_per_ms = np.zeros(1, np.int64)
    count = first_us = last_us = 0
    for chunk in chunks:
        if not count:
            first_us = int(chunk.t_us[0])
        last_us = int(chunk.t_us[-1])
        if last_us - first_us > MAX_SPAN_US:
            raise CaptureError(
                "the recording is longer than a day",
                where=where,
                got=f"events from {first_us} to {last_us} us",
                do="check the unit of its times",
            )
        ms = (last_us - first_us // MS * MS) // MS
        if ms >= len(events_per_ms):
            events_per_ms = np.concatenate(
                [events_per_ms, np.zeros(max(ms, len(events_per_ms)), np.int64)]
            )
        _count(chunk.x, chunk.y, chunk.t_us, first_us // MS * MS, events_per_pixel, events_per_ms)
        count += len(chunk)
        progress(count)
    lasts = (last_us - first_us // MS * MS) // MS + 1
    return Survey(count, first_us, last_us, events_per_pixel, events_per_ms[:lasts])


def hot_pixels(
    events_per_pixel: Int64[np.ndarray, "h w"], times: float
) -> Int64[np.ndarray, "n 2"]:
    """Columns and rows of the hot pixels.

    Args:
        events_per_pixel: Number of events of each pixel.
        times: Ratio of event counts, pixel to neighbours, from which a pixel is hot; 0: none is.
    """
    if not times:
        return np.empty((0, 2), np.int64)
    rows, columns = np.nonzero(events_per_pixel >= MIN_EVENTS)
    found = _stands_out(events_per_pixel, rows, columns, times)
    return np.stack([columns[found], rows[found]], -1)  # [n 2]


@dataclass
class EventFilter:
    """Removes unwanted events from consecutive chunks.

    An *isolated* event is one without another event at the eight pixels around it within some time
    before: mostly sensor noise.
    """

    hot: Int64[np.ndarray, "n 2"]
    """Columns and rows of pixels to remove."""
    isolated_us: int
    """Time window for isolated events; 0 keeps them."""
    span_us: tuple[int, int]
    """First and last time to keep, both inclusive."""
    size: tuple[int, int]
    hot_pixel_events: int = 0
    """Events of hot pixels removed so far."""
    isolated: int = 0
    outside: int = 0
    """Events outside the time range removed so far."""

    def __post_init__(self) -> None:
        width, height = self.size
        self._removed_pixels = np.zeros((height, width), bool)
        self._removed_pixels[self.hot[:, 1], self.hot[:, 0]] = True
        self._latest = np.full((height + 2, width + 2), np.iinfo(np.int64).min // 2)

    def filtered(self, events: EventStream) -> EventStream:
        """Remaining events of the next chunk."""
        inside = events.window(self.span_us[0], self.span_us[1] + 1)
        self.outside += len(events) - len(inside)
        if len(self.hot):
            keep = ~self._removed_pixels[inside.y, inside.x]
            self.hot_pixel_events += int((~keep).sum())
            inside = inside[np.flatnonzero(keep)]
        if self.isolated_us:
            keep = _has_neighbour(inside.x, inside.y, inside.t_us, self.isolated_us, self._latest)
            self.isolated += int((~keep).sum())
            inside = inside[np.flatnonzero(keep)]
        return inside

    def left_out(self) -> dict[str, int]:
        """Number of events removed so far, by reason."""
        counts = {
            "events of hot pixels": self.hot_pixel_events,
            "isolated events": self.isolated,
            "events outside the time range": self.outside,
        }
        return {kind: count for kind, count in counts.items() if count}

    def counts(self) -> list[int]:
        """The three counts, for `load_counts`."""
        return [self.hot_pixel_events, self.isolated, self.outside]

    def load_counts(self, counts: list[int]) -> None:
        """Set the counts of a filter that has already been applied."""
        self.hot_pixel_events, self.isolated, self.outside = counts


@njit(cache=True, nogil=True)
@no_type_check
def _count(x, y, t_us, origin_us, events_per_pixel, events_per_ms):
    height, width = events_per_pixel.shape
    for i in range(t_us.size):
        events_per_ms[(t_us[i] - origin_us) // 1000] += 1
        column, row = int(x[i]), int(y[i])  # rectified positions may lie beside the sensor
        if 0 <= column < width and 0 <= row < height:
            events_per_pixel[row, column] += 1


@njit(cache=True, nogil=True)
@no_type_check
def _stands_out(events_per_pixel, rows, columns, times):
    height, width = events_per_pixel.shape
    found = np.zeros(rows.size, np.bool_)
    for i in range(rows.size):
        row, column = rows[i], columns[i]
        top, bottom = max(row - RADIUS, 0), min(row + RADIUS + 1, height)
        left, right = max(column - RADIUS, 0), min(column + RADIUS + 1, width)
        near = np.sort(events_per_pixel[top:bottom, left:right].copy().ravel())
        reference = near[min(near.size * RANK // 25, near.size - 1)]
        found[i] = events_per_pixel[row, column] > times * (reference + 1)
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _has_neighbour(x, y, t_us, within_us, latest):
    """Mask of events after one of a neighbour; `latest` is padded by one pixel."""
    keep = np.zeros(t_us.size, np.bool_)
    for i in range(t_us.size):
        row, column, now = y[i] + 1, x[i] + 1, t_us[i]
        keep[i] = now - latest[row, column] <= within_us
        for down in range(-1, 2):
            for right in range(-1, 2):
                if down or right:
                    latest[row + down, column + right] = now
    return keep
