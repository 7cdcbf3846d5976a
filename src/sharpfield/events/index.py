"""An event stream sorted by pixel, then by time.

Vocabulary: a *site* is a pixel, or a rectified position, that can report events, see
`events.sites`. The index stores the events of site 0, then those of site 1, and so on, each in
order of time; the events of a site begin at its `offset`. Cameras follow each other: site = track *
height * width + row * width + column. A *position* is an index into that order: the next event of
the same pixel is at the next position, and the number of events between two times takes two binary
searches.

It is built by a counting sort: one pass over the stream counts, one writes. All arrays are numpy
and may be memory-mapped, see `storage.event_cache`; images of it are in `events.image`.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Int, Int8, Int64
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.events.sites import SiteOf, find_sites, parts

GROUP = 16
"""Windows searched together, see `_window`."""


@dataclass(frozen=True)
class EventIndex:
    """Events sorted by site, then by time."""

    site_xy: Float32[np.ndarray, "m 2"]
    """Column and row of each site, ascending by track, then by row, then by column. Index units:
    10.0 is the centre of pixel 10."""
    offset: Int64[np.ndarray, "o"]
    """Site s has the positions offset[s] ... offset[s+1] - 1; o = m + 1."""
    t_us: Int64[np.ndarray, "n"]
    p: Int8[np.ndarray, "n"]
    tracks: int = 1
    """Number of cameras; each has the same number of sites."""

    def __len__(self) -> int:
        """Number of events."""
        return len(self.t_us)

    @property
    def sites(self) -> int:
        """Number of sites."""
        return len(self.site_xy)

    def track_of(self, site: Int[np.ndarray, "b"]) -> Int64[np.ndarray, "b"]:
        """The track of the camera that each site belongs to."""
        return np.asarray(site, np.int64) // max(self.sites // self.tracks, 1)

    def sites_of(self, track: int) -> Int64[np.ndarray, "b"]:
        """All sites of one camera."""
        each = self.sites // self.tracks
        return np.arange(track * each, (track + 1) * each)


def build_index(events: EventStream) -> EventIndex:
    """The index of a stream, in memory.

    Raises:
        CaptureError: An event lies outside the sensor, or times go back at some pixel.
    """
    site_xy, site_of = find_sites(events)
    offset = site_offsets(events, site_of, len(site_xy))
    t_us, p = sort_sites(events, site_of, offset, first=0, last=len(site_xy))
    return EventIndex(site_xy, offset, t_us, p, events.tracks)


def site_offsets(events: EventStream, site_of: SiteOf, sites: int) -> Int64[np.ndarray, "o"]:
    """The offset of each site, o = m + 1: the first pass of the sort."""
    offset = np.zeros(sites + 1, np.int64)
    for part in parts(events):
        _count(site_of(part), offset[1:])
    return np.cumsum(offset)


def sort_sites(
    events: EventStream, site_of: SiteOf, offset: Int64[np.ndarray, "o"], *, first: int, last: int
) -> tuple[Int64[np.ndarray, "k"], Int8[np.ndarray, "k"]]:
    """Times and polarities of the sites `first` ... `last - 1`, sorted: the second pass.

    Only these sites are held in memory, so that a stream larger than memory is sorted by several
    calls.
    """
    cursor = offset[first:last] - offset[first]
    begin = cursor.copy()
    t_us = np.empty(offset[last] - offset[first], np.int64)
    p = np.empty(len(t_us), np.int8)
    for part in parts(events):
        bad = _place(site_of(part), part.t_us, part.p, first, begin, cursor, t_us, p)
        if bad >= 0:
            raise CaptureError(
                "event times are not ascending",
                where=f"pixel x {part.x[bad]}, y {part.y[bad]}",
                got=f"an event at {part.t_us[bad]} us after a later one",
                do="sort the events by time (stable), and check that clock wraps were undone",
            )
    return t_us, p


def sites_at(
    index: EventIndex, xy: Float32[np.ndarray, "b 2"], *, track: int = 0
) -> Int64[np.ndarray, "b"]:
    """The site of one camera at each exact position, or -1 where there is none."""
    each = index.sites // index.tracks
    first = track * each
    found = _sites_at(index.site_xy[first : first + each], xy)
    return np.where(found < 0, found, found + first)


def next_event(
    index: EventIndex, site: Int[np.ndarray, "b"], t_us: Int[np.ndarray, "b"]
) -> Int64[np.ndarray, "b"]:
    """Position of the first event of each site that comes after a time, or -1."""
    return _next(index.offset, index.t_us, site, t_us)


def previous_event(
    index: EventIndex, site: Int[np.ndarray, "b"], t_us: Int[np.ndarray, "b"]
) -> Int64[np.ndarray, "b"]:
    """Position of the last event of each site that comes before a time, or -1."""
    return _previous(index.offset, index.t_us, site, t_us)


def window(
    index: EventIndex,
    site: Int[np.ndarray, "b"],
    start_us: Int[np.ndarray, "b"],
    end_us: Int[np.ndarray, "b"],
) -> tuple[Int64[np.ndarray, "b"], Int64[np.ndarray, "b"]]:
    """Positions `first` ... `last - 1` of each site's events with start <= t < end.

    Times are whole us, so the events after `a` up to and including `b` are those with
    a + 1 <= t < b + 1. The number of events is `last - first`.
    """
    return _window(index.offset, index.t_us, site, start_us, end_us)


def counts(
    index: EventIndex, first: Int[np.ndarray, "b"], last: Int[np.ndarray, "b"]
) -> tuple[Int64[np.ndarray, "b"], Int64[np.ndarray, "b"]]:
    """Numbers of OFF and of ON events at positions `first` ... `last - 1`.

    Args:
        index: The events.
        first: From `window`, or any position.
        last: Of the same site; the counts are zero where it does not exceed `first`.
    """
    brighter = _brighter(index.p, first, last)
    return np.maximum(last - first, 0) - brighter, brighter


def signed_sum(
    index: EventIndex,
    site: Int[np.ndarray, "b"],
    start_us: Int[np.ndarray, "b"],
    end_us: Int[np.ndarray, "b"],
) -> Int64[np.ndarray, "b"]:
    """Sum of the polarities of each site's events with start <= t < end."""
    darker, brighter = counts(index, *window(index, site, start_us, end_us))
    return brighter - darker


def chains(index: EventIndex, hops: int = 1) -> Int64[np.ndarray, "o"]:
    """Offset of each site in the list of all events that have at least `hops` successors.

    The last entry is the length of that list; draw a rank below it and call `chain_start`.
    """
    found = np.maximum(np.diff(index.offset) - hops, 0)
    return np.concatenate([[0], np.cumsum(found)]).astype(np.int64)


def chain_start(
    index: EventIndex, chain: Int64[np.ndarray, "o"], rank: Int64[np.ndarray, "b"]
) -> tuple[Int64[np.ndarray, "b"], Int64[np.ndarray, "b"]]:
    """Site and position of the events of the given ranks; `position + 1` is the successor.

    Args:
        index: The events.
        chain: From `chains`.
        rank: 0 to `chain[-1] - 1`.
    """
    site = np.searchsorted(chain, rank, side="right") - 1
    return site, index.offset[site] + rank - chain[site]


@njit(cache=True, nogil=True)
@no_type_check
def _count(site, count):
    for i in range(site.size):
        count[site[i]] += 1


@njit(cache=True, nogil=True)
@no_type_check
def _place(site, t_us, p, first, begin, cursor, t_out, p_out):
    """Append each event to its site; the index of the first that goes back in time, or -1."""
    for i in range(site.size):
        s = site[i] - first
        if s < 0 or s >= cursor.size:
            continue
        k = cursor[s]
        if k > begin[s] and t_out[k - 1] > t_us[i]:
            return i
        t_out[k], p_out[k] = t_us[i], p[i]
        cursor[s] = k + 1
    return -1


@njit(cache=True, nogil=True)
@no_type_check
def first_since(t_us, low, high, time):
    """First position in low ... high - 1 whose time is at least `time`, or `high`; for kernels."""
    while low < high:
        middle = (low + high) >> 1
        if t_us[middle] < time:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
@no_type_check
def _sites_at(site_xy, xy):
    found = np.full(len(xy), -1, np.int64)
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        low, high = 0, len(site_xy)
        while low < high:
            middle = (low + high) >> 1
            column, row = site_xy[middle, 0], site_xy[middle, 1]
            if row < y or (row == y and column < x):
                low = middle + 1
            else:
                high = middle
        if low < len(site_xy) and site_xy[low, 0] == x and site_xy[low, 1] == y:
            found[i] = low
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _next(offset, t_us, site, time):
    found = np.empty(site.size, np.int64)
    for i in range(site.size):
        end = offset[site[i] + 1]
        k = first_since(t_us, offset[site[i]], end, time[i] + 1)
        found[i] = k if k < end else -1
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _previous(offset, t_us, site, time):
    found = np.empty(site.size, np.int64)
    for i in range(site.size):
        begin = offset[site[i]]
        k = first_since(t_us, begin, offset[site[i] + 1], time[i])
        found[i] = k - 1 if k > begin else -1
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _window(offset, t_us, site, start_us, end_us):
    """Both ends of many windows, by binary searches that advance in groups.

    A binary search waits for memory at each step; searches of a group do not depend on each
    other, so that the CPU waits for many at once (1.5 times the speed of one by one).
    """
    first, last = np.empty(site.size, np.int64), np.empty(site.size, np.int64)
    found = np.empty(2 * GROUP, np.int64)
    left, time = np.empty_like(found), np.empty_like(found)
    for begin in range(0, site.size, GROUP):
        size = min(GROUP, site.size - begin)
        longest = 0
        for j in range(size):
            i = begin + j
            low, high = offset[site[i]], offset[site[i] + 1]
            found[j], found[j + size] = low, low
            left[j], left[j + size] = high - low, high - low
            time[j], time[j + size] = start_us[i], end_us[i]
            longest = max(longest, high - low)
        while longest > 0:
            for j in range(2 * size):
                half = (left[j] + 1) >> 1
                if half > 0:
                    later = t_us[found[j] + half - 1] < time[j]
                    found[j] += half if later else 0
                    left[j] = left[j] - half if later else half - 1
            longest >>= 1
        for j in range(size):
            first[begin + j], last[begin + j] = found[j], found[j + size]
    return first, last


@njit(cache=True, nogil=True)
@no_type_check
def _brighter(p, first, last):
    found = np.empty(first.size, np.int64)
    for i in range(first.size):
        total = 0
        for k in range(first[i], last[i]):
            total += p[k] > 0
        found[i] = total
    return found
