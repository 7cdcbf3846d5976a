"""Event frames: events accumulated in windows of a fixed time grid, as EvDNeRF trains on them.

Vocabulary: an *event frame* holds the net number of events of each pixel of one camera in one
window of the grid. Half of a batch are pixels with events, half are any pixels, each from an event
frame drawn at random. Pixels may be *blocks* of two by two, as the released code downsamples its
data.

Source: EvDNeRF (WACV 2024), supplement, and its released code.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int32, Int64
from torch import Tensor

from sharpfield.core.capture import Clock
from sharpfield.core.measurements import EventPairs
from sharpfield.core.seed import numpy_generator
from sharpfield.events.index import EventIndex, counts, window

Halved = Literal["no", "fairly", "as released"]
"""Single pixels; or blocks, whose sum over four is rounded towards zero, or, from sums of
floating-point thresholds, downwards, which counts a whole event for a block with one OFF event."""

FEWEST = 3
"""Windows that are drawn from at the first step."""


@dataclass(frozen=True)
class BinnedTable:
    """Event frames of several cameras, and the pixels with events."""

    net: Int32[np.ndarray, "v k h w"]
    """ON events minus OFF events."""
    track: Int64[np.ndarray, "v"]
    clock: Clock
    block: int
    """Pixels along the edge of a block."""
    busy: Int64[np.ndarray, "m"]
    """Flat indices of `net` with events, ascending."""
    first: Int64[np.ndarray, "f"]
    """Offset of each event frame in `busy`; f = v k + 1."""
    centre: tuple[float, float]
    """Mean row and column of the pixels with events in the first event frame."""

    @property
    def most(self) -> int:
        """Largest net number of events."""
        return int(np.abs(self.net).max(initial=0))


def binned_table(
    index: EventIndex, clock: Clock, windows: int, size: tuple[int, int], *, halved: Halved = "no"
) -> BinnedTable:
    """Event frames of all cameras that reported anything.

    Args:
        index: The events; whole pixels, `height * width` of each camera.
        clock: Of the capture, which is divided into the windows.
        windows: Their number.
        size: Width and height of the sensor; even if halved.
        halved: Whether blocks of pixels count as one.
    """
    width, height = size
    edge_us = clock.us(np.linspace(0, 1, windows + 1))
    edge_us[-1] += 1  # the last instant belongs to the last window
    tracks = [k for k in range(index.tracks) if np.diff(index.offset[index.sites_of(k)]).any()]
    net = np.zeros((len(tracks), windows, height, width), np.int32)
    for v, track in enumerate(tracks):
        sites = index.sites_of(track)
        for k in range(windows):
            start, end = (np.full(len(sites), edge_us[k + i]) for i in (0, 1))
            darker, brighter = counts(index, *window(index, sites, start, end))
            net[v, k] = (brighter - darker).reshape(height, width)
    if halved != "no":
        net = halve(net) if halved == "fairly" else halve_as_released(net * RELEASED_THRESHOLD)
    return _table(net, np.array(tracks, np.int64), clock, block=1 if halved == "no" else 2)


RELEASED_THRESHOLD = 0.2
"""Threshold with which the released code downsamples data, whatever the data set."""


def halve(net: Int32[np.ndarray, "*n h w"]) -> Int32[np.ndarray, "*n i j"]:
    """A quarter of the sum of each block, rounded towards zero: symmetric in sign."""
    return np.trunc(_blocks(net) / 4).astype(np.int32)


def halve_as_released(sums: Float64[np.ndarray, "*n h w"]) -> Int32[np.ndarray, "*n i j"]:
    """Sums of thresholds divided by four of them and rounded downwards, in floating point."""
    return (_blocks(sums) // (4 * RELEASED_THRESHOLD)).astype(np.int32)


def draw_binned(
    table: BinnedTable,
    count: int,
    *,
    seed: int,
    step: int,
    until: int,
    cropped: bool = False,
    device: torch.device | str = "cpu",
) -> EventPairs:
    """Half pixels with events, half any pixels, each from an event frame drawn at random.

    Event frames without events are not drawn for the first half.

    Args:
        table: Event frames.
        count: Number of pixels.
        seed: The run's seed.
        step: The training step.
        until: Number of windows to draw from, see `open_windows`.
        cropped: Only pixels of a box around the centre, half as wide and high as the image.
        device: Of the result.
    """
    random = numpy_generator(seed, step, "binned")
    views, windows, height, width = table.net.shape
    low, high = _crop(table) if cropped else ((0, 0), (height, width))
    frames = (np.arange(views)[:, None] * windows + np.arange(until)).ravel()
    busy = _busy_places(table, frames, (low, high)) if cropped else None
    half = count // 2
    held = np.diff(table.first)[frames]
    if not held.any():  # nothing has moved yet: all pixels are without events
        half, place = 0, np.zeros(0, np.int64)
    elif busy is None:
        chosen = random.choice(frames[held > 0], half)
        within = random.random(half) * (table.first[chosen + 1] - table.first[chosen])
        place = table.busy[table.first[chosen] + within.astype(np.int64)]
    else:
        place = random.choice(busy, half)
    any_frame = random.choice(frames, count - half)
    row = random.integers(low[0], high[0], count - half)
    column = random.integers(low[1], high[1], count - half)
    place = np.concatenate([place, (any_frame * height + row) * width + column])
    return _pairs(table, place).to(device)


def open_windows(step: int, windows: int, warm_up: int) -> int:
    """Number of windows, from the first, that are drawn from: all after the warm-up.

    Source: the released code, which counts one image more than there are windows.
    """
    if step >= warm_up:
        return windows
    return min(max(FEWEST, int(np.ceil(min(step / warm_up * (windows + 1), windows)))), windows)


def _table(net: np.ndarray, track: np.ndarray, clock: Clock, *, block: int) -> BinnedTable:
    busy = np.flatnonzero(net)
    pixels = net.shape[2] * net.shape[3]
    first = np.searchsorted(busy, np.arange(net.shape[0] * net.shape[1] + 1) * pixels)
    rows, columns = np.nonzero(np.abs(net[0, 0]) > 1) if len(net) else (np.zeros(0),) * 2
    middle = (net.shape[2] / 2, net.shape[3] / 2)
    centre = (float(rows.mean()), float(columns.mean())) if len(rows) else middle
    return BinnedTable(net, track, clock, block, busy, first.astype(np.int64), centre)


def _blocks(values: np.ndarray) -> np.ndarray:
    *leading, height, width = values.shape
    return values.reshape(*leading, height // 2, 2, width // 2, 2).sum((-3, -1))


def _crop(table: BinnedTable) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last row and column of the box, shifted to lie inside the image."""
    low, high = [], []
    for centre, cells in zip(table.centre, table.net.shape[2:], strict=True):
        half = cells // 4
        begin = int(np.clip(round(centre) - half, 0, cells - 2 * half))
        low.append(begin)
        high.append(begin + max(2 * half, 1))
    return (low[0], low[1]), (high[0], high[1])


def _busy_places(
    table: BinnedTable, frames: np.ndarray, crop: tuple[tuple[int, int], tuple[int, int]]
) -> Int64[np.ndarray, "m"]:
    """Indices of pixels with events inside the box, or anywhere if there are none."""
    (top, left), (bottom, right) = crop
    _, _, height, width = table.net.shape
    frame, pixel = np.divmod(table.busy, height * width)
    row, column = np.divmod(pixel, width)
    inside = (row >= top) & (row < bottom) & (column >= left) & (column < right)
    open_ = np.isin(frame, frames)
    return table.busy[inside & open_] if (inside & open_).any() else table.busy[open_]


def _pairs(table: BinnedTable, place: Int64[np.ndarray, "b"]) -> EventPairs:
    views, windows, height, width = table.net.shape
    frame, pixel = np.divmod(place, height * width)
    row, column = np.divmod(pixel, width)
    view, k = np.divmod(frame, windows)
    net = table.net.ravel()[place]

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values.astype(np.float32))

    return EventPairs(
        xy=tensor((np.stack([column, row], -1) + 0.5) * table.block),
        track=torch.from_numpy(table.track[view]),
        start=tensor(k / windows),
        end=tensor((k + 1) / windows),
        negative=tensor(np.minimum(net, 0)),
        positive=tensor(np.maximum(net, 0)),
    )
