"""Sites: the pixels of an event camera, or the distinct positions of rectified events.

Sites are numbered by row, then by column. With integer coordinates every pixel is a site, whether
it ever fires or not. Rectified positions are collected from the stream itself, with a hash table of
the bits of their coordinates: two events are of one site if their positions are exactly equal.
Cameras of several tracks have their own sites: first all of track 0, then those of track 1.

On a colour sensor each site is behind one colour filter, see `events.site_colour`.
"""

from collections.abc import Callable, Iterator
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Int32, Int64, Shaped, UInt32, UInt64
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream

CHUNK = 2**22
"""Events processed at once; bounds the temporary memory."""

SiteOf = Callable[[EventStream], Int32[np.ndarray, "n"]]
"""The site of each event of a part of the stream."""


def parts(events: EventStream) -> Iterator[EventStream]:
    """The stream in slices of `CHUNK` events."""
    for first in range(0, len(events), CHUNK):
        yield events[first : first + CHUNK]


def find_sites(events: EventStream) -> tuple[Float32[np.ndarray, "m 2"], SiteOf]:
    """All sites of a stream, and the function that gives the site of each event.

    Returns:
        site_xy: Column and row of each site, ascending by track, then by row, then by column.
        site_of: To be called with parts of the same stream.

    Raises:
        CaptureError: Positions of several cameras are rectified.
    """
    if events.rectified:
        if events.tracks > 1:
            raise CaptureError(
                "events of several cameras must name pixels, not rectified positions",
                got=f"{events.tracks} tracks with float coordinates",
                do="keep the raw coordinates, and give the camera its lens",
            )
        return _rectified_sites(events)
    width, height = events.width, events.height
    y, x = np.divmod(np.arange(width * height), width)
    site_xy = np.stack([x, y], -1).astype(np.float32)
    return np.tile(site_xy, (events.tracks, 1)), _pixel_site


def _pixel_site(events: EventStream) -> Int32[np.ndarray, "n"]:
    site = np.empty(len(events), np.int32)
    bad = _number_pixels(events.x, events.y, events.width, events.height, site)
    if bad >= 0:
        raise CaptureError(
            "an event lies outside the sensor",
            where=f"{len(events)} events from {events.t_us[0]} us, event {bad} of them",
            got=f"x {events.x[bad]}, y {events.y[bad]}, sensor {events.width}x{events.height}",
            do="check the sensor size, and whether the file counts pixels from 1",
        )
    if events.track is not None:
        site += events.track.astype(np.int32) * np.int32(events.width * events.height)
    return site


def _rectified_sites(events: EventStream) -> tuple[Float32[np.ndarray, "m 2"], SiteOf]:
    table = np.full(2**16, -1, np.int32)  # hash -> number, in order of appearance
    keys = np.zeros(2**15, np.uint64)  # number -> bits of its position; at most half the table
    known = 0
    for part in parts(events):
        x, y = _bits(part.x), _bits(part.y)
        done = 0
        while True:
            done, known = _collect(x, y, done, table, keys, known)
            if done == len(x):
                break
            table = np.full(4 * len(table), -1, np.int32)
            keys = np.concatenate([keys[:known], np.zeros(len(table) // 2 - known, np.uint64)])
            _enter(keys[:known], table)
    keys = keys[:known]
    halves = keys.view(np.uint32).reshape(-1, 2)  # little-endian: column bits first
    xy = np.ascontiguousarray(halves).view(np.float32)
    order = np.lexsort((xy[:, 0], xy[:, 1]))
    number = np.empty(known, np.int32)
    number[order] = np.arange(known, dtype=np.int32)

    def site_of(part: EventStream) -> Int32[np.ndarray, "n"]:
        return number[_look_up(_bits(part.x), _bits(part.y), table, keys)]

    return xy[order], site_of


def _bits(position: Shaped[np.ndarray, "n"]) -> UInt32[np.ndarray, "n"]:
    """The bits of float32 positions; adding zero makes -0.0 equal to 0.0."""
    return (np.asarray(position, np.float32) + np.float32(0)).view(np.uint32)


@njit(cache=True, nogil=True)
@no_type_check
def _number_pixels(
    x: Shaped[np.ndarray, "n"],
    y: Shaped[np.ndarray, "n"],
    width: int,
    height: int,
    site: Int32[np.ndarray, "n"],
) -> int:
    """Fill `site`; the index of the first event outside the sensor, or -1."""
    for i in range(x.size):
        column, row = np.int64(x[i]), np.int64(y[i])
        if column < 0 or column >= width or row < 0 or row >= height:
            return i
        site[i] = row * width + column
    return -1


@njit(cache=True, nogil=True)
@no_type_check
def _slot(key: np.uint64, table: Int32[np.ndarray, "h"], keys: UInt64[np.ndarray, "k"]) -> int:
    """The slot of `key` in the table, or the free slot where it belongs (linear probing)."""
    mask = np.uint64(table.size - 1)
    mixed = (key ^ (key >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed >> np.uint64(24)) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + np.uint64(1)) & mask
    return np.int64(slot)


@njit(cache=True, nogil=True)
@no_type_check
def _key(x: np.uint32, y: np.uint32) -> np.uint64:
    return (np.uint64(y) << np.uint64(32)) | np.uint64(x)


@njit(cache=True, nogil=True)
@no_type_check
def _collect(
    x: UInt32[np.ndarray, "n"],
    y: UInt32[np.ndarray, "n"],
    done: int,
    table: Int32[np.ndarray, "h"],
    keys: UInt64[np.ndarray, "k"],
    known: int,
) -> tuple[int, int]:
    """Number new positions from event `done` on; stops early when `keys` is full."""
    for i in range(done, x.size):
        key = _key(x[i], y[i])
        slot = _slot(key, table, keys)
        if table[slot] < 0:
            if known == keys.size:
                return i, known
            table[slot] = known
            keys[known] = key
            known += 1
    return x.size, known


@njit(cache=True, nogil=True)
@no_type_check
def _enter(keys: UInt64[np.ndarray, "k"], table: Int32[np.ndarray, "h"]) -> None:
    """Enter numbered keys into an empty table."""
    for number in range(keys.size):
        table[_slot(keys[number], table, keys)] = number


@njit(cache=True, nogil=True)
@no_type_check
def _look_up(
    x: UInt32[np.ndarray, "n"],
    y: UInt32[np.ndarray, "n"],
    table: Int32[np.ndarray, "h"],
    keys: UInt64[np.ndarray, "k"],
) -> Int64[np.ndarray, "n"]:
    number = np.empty(x.size, np.int64)
    for i in range(x.size):
        number[i] = table[_slot(_key(x[i], y[i]), table, keys)]
    return number
