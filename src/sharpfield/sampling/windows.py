"""Events counted in windows of time, of any pixel of any camera.

Vocabulary: a *window* is a pixel and two instants; its counts are those of the events after the
first instant up to and including the second. Its length is log-uniform, so that short windows are
as frequent as long ones. A *span* is a window that begins and ends with an event of its pixel. At
these instants the reference level of the pixel equals its log light, so that the counts of a span
measure the change of light exactly, while at the ends of other windows there is an unknown rest of
up to a threshold.

Source: EvDNeRF (WACV 2024) for windows of half event pixels and half random pixels over all views;
Robust e-NeRF (ICCV 2023) for reference levels.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from sharpfield.core.measurements import EventPairs
from sharpfield.core.seed import numpy_generator
from sharpfield.events.index import EventIndex, chain_start, counts, window
from sharpfield.sampling.pixels_and_pairs import Device, PairTable, pairs_between, pairs_of


@dataclass(frozen=True)
class Lengths:
    """Lengths of windows, and the part of the recording they are in; in fractions of it."""

    shortest: float = 1 / 256
    """Length of the shortest window."""
    longest: float = 1.0
    """Length of the longest window."""
    until: float = 1.0
    """Windows end before this time."""

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Lengths, log-uniform."""
        low, high = np.log(min(self.shortest, self.until)), np.log(min(self.longest, self.until))
        return np.exp(low + random.random(count) * (high - low))


def draw_windows(
    table: PairTable,
    count: int,
    lengths: Lengths,
    *,
    seed: int,
    step: int,
    busy: float = 0.5,
    device: Device = "cpu",
) -> EventPairs:
    """`count` windows of pixels of all cameras.

    Args:
        table: Of the events.
        count: Their number.
        lengths: Of the windows.
        seed: The run's seed.
        step: The training step.
        busy: Fraction of the windows that contain an event: an event is drawn, then a window around
            it. The others are of any pixel at any time.
        device: Of the result.
    """
    random = numpy_generator(seed, step, "windows")
    clock = table.clock
    holding = round(busy * count)
    length = lengths.draw(random, count)
    start = random.random(count) * (lengths.until - length)
    position = random.integers(len(table.index), size=holding)
    event_site = np.searchsorted(table.index.offset, position, side="right") - 1
    at = clock.unit(table.index.t_us[position])
    before = at - random.random(holding) * length[:holding]
    start[:holding] = np.clip(before, 0, lengths.until - length[:holding])
    site = np.concatenate([event_site, _any_site(table.index, random, count - holding)])
    first_us, last_us = clock.us(start), clock.us(start + length)
    found = counts(table.index, *window(table.index, site, first_us + 1, last_us + 1))
    return pairs_of(table, site, (clock.unit(first_us), clock.unit(last_us)), found).to(device)


def draw_spans(
    table: PairTable, count: int, *, seed: int, step: int, device: Device = "cpu"
) -> EventPairs:
    """`count` spans: an event and a later one of its pixel.

    The number of events in between is log-uniform.
    """
    random = numpy_generator(seed, step, "spans")
    rank = random.integers(len(table), size=count)
    site, first = chain_start(table.index, table.chain, rank)
    left = table.index.offset[site + 1] - 1 - first
    more = np.floor((left + 1.0) ** random.random(count)).astype(np.int64)
    return pairs_between(table, site, first, first + np.clip(more, 1, left)).to(device)


def _any_site(index: EventIndex, random: np.random.Generator, count: int) -> Int64[np.ndarray, "b"]:
    """Random sites of the cameras with any events: others may not have been recording."""
    each = index.sites // index.tracks
    reported = np.diff(index.offset[:: max(each, 1)]) > 0
    track = random.choice(np.flatnonzero(reported), size=count)
    return track * each + random.integers(each, size=count)
