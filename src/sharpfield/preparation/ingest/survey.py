"""The first look at the events of a recording: how many, when, and which pixels cannot be right.

A *hot* pixel reports all the time whatever it sees. It is told by its neighbours: edges that move
over one pixel move over those beside it, so no sound pixel reports many times as often as nearly
all of the 24 around it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Int64, Shaped
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Chunks

MS = 1000
LONGEST_US = 24 * 3600 * 1_000_000
"""No recording is longer than a day: then the unit of its times is wrong."""

FEWEST = 20
"""A pixel that reported less often in all is not called hot."""
AROUND, QUIET = 2, 20
"""A pixel's neighbours are so many pixels around it; all but the QUIET'th quietest are looked over:
a thin line, or two hot pixels side by side, may be among them."""

Heard = Callable[[int], None]
"""Is told how many events were gone through."""


@dataclass(frozen=True)
class Survey:
    """What was found."""

    count: int
    first_us: int
    last_us: int
    """Times of the first and the last event; both 0 if there are none."""
    per_pixel: Int64[np.ndarray, "h w"]
    """How often each pixel reported."""
    per_ms: Int64[np.ndarray, "m"]
    """Events in each ms since the first one's."""

    @property
    def origin_us(self) -> int:
        """The whole ms from which `per_ms` counts."""
        return self.first_us // MS * MS


def survey(chunks: Chunks, size: tuple[int, int], where: object, heard: Heard) -> Survey:
    """Go through all events once, in bounded memory.

    Args:
        chunks: The events.
        size: Width and height of the sensor.
        where: The file, for messages.
        heard: Is told how far it has come.

    Raises:
        CaptureError: The recording is longer than a day.
    """
    per_pixel = np.zeros(size[::-1], np.int64)
    per_ms = np.zeros(1, np.int64)
    count = first_us = last_us = 0
    for chunk in chunks:
        if not count:
            first_us = int(chunk.t_us[0])
        last_us = int(chunk.t_us[-1])
        if last_us - first_us > LONGEST_US:
            raise CaptureError(
                "the recording is longer than a day",
                where=where,
                got=f"events from {first_us} to {last_us} us",
                do="check the unit of its times",
            )
        ms = (last_us - first_us // MS * MS) // MS
        if ms >= len(per_ms):
            per_ms = np.concatenate([per_ms, np.zeros(max(ms, len(per_ms)), np.int64)])
        _count(chunk.x, chunk.y, chunk.t_us, first_us // MS * MS, per_pixel, per_ms)
        count += len(chunk)
        heard(count)
    lasts = (last_us - first_us // MS * MS) // MS + 1
    return Survey(count, first_us, last_us, per_pixel, per_ms[:lasts])


def hot_pixels(per_pixel: Int64[np.ndarray, "h w"], times: float) -> Int64[np.ndarray, "n 2"]:
    """Columns and rows of the hot pixels, by how often each pixel reported.

    Args:
        per_pixel: Counts of events.
        times: How many times as often as its neighbours a pixel reports to be called hot; 0 calls
            none so.
    """
    if not times:
        return np.empty((0, 2), np.int64)
    rows, columns = np.nonzero(per_pixel >= FEWEST)
    found = _stands_out(per_pixel, rows, columns, times)
    return np.stack([columns[found], rows[found]], -1)


@dataclass
class Sieve:
    """Takes out of a stream what its owner does not want; consecutive chunks, in their order.

    A *lonely* event is one that none of the eight pixels around it joined within some time before:
    noise of the sensor, mostly.
    """

    hot: Int64[np.ndarray, "n 2"]
    """Pixels to be silenced."""
    lonely_us: int
    """0 keeps lonely events."""
    span_us: tuple[int, int]
    """First and last time to keep, both included."""
    size: tuple[int, int]
    of_hot: int = 0
    """Events of hot pixels left out so far."""
    lonely: int = 0
    outside: int = 0
    """Events outside the time to keep."""

    def __post_init__(self) -> None:
        width, height = self.size
        self._silenced = np.zeros((height, width), bool)
        self._silenced[self.hot[:, 1], self.hot[:, 0]] = True
        self._latest = np.full((height + 2, width + 2), np.iinfo(np.int64).min // 2)

    def sifted(self, events: EventStream) -> EventStream:
        """What is kept of the next chunk."""
        inside = events.window(self.span_us[0], self.span_us[1] + 1)
        self.outside += len(events) - len(inside)
        if len(self.hot):
            keep = ~self._silenced[inside.y, inside.x]
            self.of_hot += int((~keep).sum())
            inside = chosen(inside, keep)
        if self.lonely_us:
            keep = _joined(inside.x, inside.y, inside.t_us, self.lonely_us, self._latest)
            self.lonely += int((~keep).sum())
            inside = chosen(inside, keep)
        return inside

    @property
    def taken(self) -> int:
        """How many events were taken out so far."""
        return self.of_hot + self.lonely + self.outside

    def left_out(self) -> dict[str, int]:
        """How many events were left out so far, by reason."""
        found = {
            "events of hot pixels": self.of_hot,
            "lonely events": self.lonely,
            "events outside the time to keep": self.outside,
        }
        return {kind: count for kind, count in found.items() if count}


def chosen(events: EventStream, keep: Shaped[np.ndarray, "n"]) -> EventStream:
    """Some of the events of one camera, copied."""
    return EventStream(
        x=events.x[keep],
        y=events.y[keep],
        t_us=events.t_us[keep],
        p=events.p[keep],
        width=events.width,
        height=events.height,
        bayer=events.bayer,
        site_colour=events.site_colour,
    )


@njit(cache=True, nogil=True)
@no_type_check
def _count(x, y, t_us, origin_us, per_pixel, per_ms):
    height, width = per_pixel.shape
    for i in range(t_us.size):
        per_ms[(t_us[i] - origin_us) // 1000] += 1
        column, row = int(x[i]), int(y[i])  # rectified positions may lie beside the sensor
        if 0 <= column < width and 0 <= row < height:
            per_pixel[row, column] += 1


@njit(cache=True, nogil=True)
@no_type_check
def _stands_out(per_pixel, rows, columns, times):
    height, width = per_pixel.shape
    found = np.zeros(rows.size, np.bool_)
    for i in range(rows.size):
        row, column = rows[i], columns[i]
        top, bottom = max(row - AROUND, 0), min(row + AROUND + 1, height)
        left, right = max(column - AROUND, 0), min(column + AROUND + 1, width)
        near = np.sort(per_pixel[top:bottom, left:right].copy().ravel())
        loud = near[min(near.size * QUIET // 25, near.size - 1)]
        found[i] = per_pixel[row, column] > times * (loud + 1)
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _joined(x, y, t_us, within_us, latest):
    """Which events a neighbour came before; `latest` has a border of one pixel."""
    keep = np.zeros(t_us.size, np.bool_)
    for i in range(t_us.size):
        row, column, now = y[i] + 1, x[i] + 1, t_us[i]
        keep[i] = now - latest[row, column] <= within_us
        for down in range(-1, 2):
            for right in range(-1, 2):
                if down or right:
                    latest[row + down, column + right] = now
    return keep
