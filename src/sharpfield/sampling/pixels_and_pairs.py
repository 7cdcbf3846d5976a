"""Training batches of pixels and of event pairs, as pure functions of the seed and the step.

A *table* is prepared once and describes the population; drawing from it picks a batch. Batches are
drawn without replacement: successive steps take successive parts of a shuffled order, an epoch ends
when fewer than a batch are left, and the next epoch has another order. There is no state between
steps, so the batch of step 700 does not depend on how step 700 was reached.

Images and events stay as they are stored (and may be memory-mapped); only the batch is converted.

A *patch* is p by p pixels with a spacing of `apart` pixels: with a wide spacing, a kernel of few
pixels on the patch represents a long blur in the image. Patches of one pixel are pixels.

Source: Hybrid Neural Rendering (CVPR 2023), whose patches are 8x8, 1 to 8 pixels apart.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int8, Int64, Shaped
from torch import Tensor

from sharpfield.core.capture import Capture, Clock
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.measurements import EventPairs, Pixels
from sharpfield.core.seed import number, numpy_generator, shuffled
from sharpfield.events.counts import site_channels
from sharpfield.events.index import (
    EventIndex,
    chain_start,
    chains,
    counts,
    next_event,
    previous_event,
)

Device = torch.device | str

PIXEL_CENTRE = 0.5
"""Events name pixels by index; the centre of pixel 10 is at 10.5."""


@dataclass(frozen=True)
class PixelTable:
    """Every pixel of the training frames."""

    images: Shaped[np.ndarray, "n h w c"]
    """All frames of the capture, as stored."""
    white: float
    """The stored value that means 1."""
    frame: Int64[np.ndarray, "a"]
    """The training frames."""
    track: Int64[np.ndarray, "n"]
    time: Float32[np.ndarray, "n 2"]
    """Opening and closing of each shutter, 0...1 of the capture."""

    def __len__(self) -> int:
        """Number of pixels."""
        return len(self.frame) * self.images.shape[1] * self.images.shape[2]


@dataclass(frozen=True)
class PairTable:
    """Every event that has enough successors at its pixel."""

    index: EventIndex
    chain: Int64[np.ndarray, "o"]
    """Offset of each site's events in the population, see `events.index.chains`."""
    successors: int
    """Fewest successors of each event of the population."""
    site_xy: Float32[np.ndarray, "m 2"]
    """Position of each site, in pixels (centres at +0.5)."""
    channel: Int8[np.ndarray, "m"] | None
    """Colour filter of each site; None on a mono sensor."""
    clock: Clock

    def __len__(self) -> int:
        """Number of events in the population."""
        return int(self.chain[-1])


def pixel_table(
    capture: Capture, *, images: Shaped[np.ndarray, "n h w c"] | None = None
) -> PixelTable:
    """The pixels of a capture's training frames.

    Args:
        capture: Must have frames.
        images: Other images to take values from, e.g. deblurred ones; 0...1 if they are floats.

    Raises:
        CaptureError: No frame is for training.
    """
    frames = capture.needed_frames
    if not len(capture.split.train):
        raise CaptureError(
            "no frame is left to learn from", where=capture.name, got="all are held out"
        )
    images = frames.images if images is None else images
    white = 1.0 if images.dtype.kind == "f" else float(np.iinfo(images.dtype).max)
    return PixelTable(images, white, capture.split.train, frames.track, capture.frame_time.numpy())


def draw_pixels(
    table: PixelTable, count: int, *, seed: int, step: int, device: Device = "cpu"
) -> Pixels:
    """`count` pixels of the training frames, or all of them if there are fewer."""
    drawn = _drawn(len(table), count, seed=seed, step=step, stream="pixels")
    height, width = table.images.shape[1:3]
    which, pixel = np.divmod(drawn, height * width)
    return _pixels(table, table.frame[which], *np.divmod(pixel, width)).to(device)


def _pixels(
    table: PixelTable,
    frame: Int64[np.ndarray, "*b"],
    row: Int64[np.ndarray, "*b"],
    column: Int64[np.ndarray, "*b"],
) -> Pixels:
    open_close = torch.from_numpy(table.time[frame])
    value = table.images[frame, row, column].astype(np.float32) / np.float32(table.white)
    xy = np.stack([column, row], -1).astype(np.float32) + np.float32(PIXEL_CENTRE)
    return Pixels(
        xy=torch.from_numpy(xy),
        frame=torch.from_numpy(frame),
        track=torch.from_numpy(table.track[frame]),
        open=open_close[..., 0],
        close=open_close[..., 1],
        value=torch.from_numpy(value),
    )


def pair_table(
    capture: Capture, index: EventIndex, *, successors: int = 1, half_pixel: bool = True
) -> PairTable:
    """The events of a capture that have at least `successors` later events at their pixel.

    Args:
        capture: Must have events.
        index: The capture's events by pixel.
        successors: At least 1. Chains of m pairs need m; accumulating `least` to `most` events
            needs `least + 1`.
        half_pixel: Whether rectified positions count from the centre of the first pixel, as ours
            do (10.0 is the centre of pixel 10), or from the image's corner, as in the released
            Ev-DeblurNeRF code. Integer coordinates are always pixel indices.

    Raises:
        CaptureError: There are no such events, or the colour of a site is not known.
    """
    events = capture.needed_events
    centred = half_pixel or not events.rectified
    table = PairTable(
        index=index,
        chain=chains(index, successors),
        successors=successors,
        site_xy=index.site_xy + np.float32(PIXEL_CENTRE if centred else 0.0),
        channel=site_channels(events, index),
        clock=capture.clock,
    )
    if not len(table):
        raise CaptureError(
            f"no event has {successors} later event(s) at its pixel",
            where=capture.name,
            got=f"{len(index)} events on {index.sites} pixels",
            do="use more events, or shorter chains",
        )
    return table


def draw_pairs(
    table: PairTable,
    count: int,
    *,
    seed: int,
    step: int,
    accumulate: tuple[int, int] = (0, 0),
    device: Device = "cpu",
) -> EventPairs:
    """`count` events, each with a later event of its pixel; or all events if there are fewer.

    By default the later event is the next one. `accumulate=(least, most)` skips some: the pair
    then spans 1 + round(U(least - 1, min(most, successors) - 1)) events.

    Args:
        table: Of events with more than `least` successors.
        count: How many to draw.
        seed: The run's seed.
        step: The training step.
        accumulate: Fewest and most events that a pair spans; (0, 0) means the next event.
        device: Of the result.

    Source: Ev-DeblurNeRF (CVPR 2024), event-by-event supervision and the study of fig. 4.
    """
    drawn = _drawn(len(table), count, seed=seed, step=step, stream="pairs")
    site, first = chain_start(table.index, table.chain, drawn)
    span = np.ones(len(drawn), np.int64)
    if accumulate != (0, 0):
        least, most = accumulate
        assert table.successors > least, f"table of {table.successors} successors, least {least}"
        reach = np.minimum(most, table.index.offset[site + 1] - 1 - first)
        uniform = numpy_generator(seed, step, "pairs/span").random(len(drawn))
        # The reference adds 1e-5 to the upper end, which keeps it from being empty.
        span = np.rint(least - 1 + uniform * (reach - least + 1e-5)).astype(np.int64) + 1
        span = np.maximum(span, 1)
    return pairs_between(table, site, first, first + span).to(device)


def draw_chains(
    table: PairTable, count: int, length: int, *, seed: int, step: int, device: Device = "cpu"
) -> EventPairs:
    """`[count, length]` pairs: runs of consecutive events of one pixel.

    Each pair begins where the one before it ended, so `length` pairs need only `length + 1`
    renders instead of twice as many.

    Args:
        table: Of events with at least `length` successors.
        count: How many chains to draw.
        length: Pairs per chain.
        seed: The run's seed.
        step: The training step.
        device: Of the result.
    """
    assert table.successors >= length, f"table of {table.successors} successors, chains of {length}"
    drawn = _drawn(len(table), count, seed=seed, step=step, stream="chains")
    site, first = chain_start(table.index, table.chain, drawn)
    start = (first[:, None] + np.arange(length)).ravel()
    pairs = pairs_between(table, np.repeat(site, length), start, start + 1)
    return pairs.reshape(-1, length).to(device)


def draw_silent(
    table: PairTable, count: int, *, seed: int, step: int, device: Device = "cpu"
) -> EventPairs:
    """`count` pairs of instants without any event of the pixel in between.

    Log intensity changed by less than a threshold between them. Pixels and times are uniform; both
    instants are between the same two events, or before the first or after the last.
    """
    index, random = table.index, numpy_generator(seed, step, "silent")
    begin, end = int(index.t_us.min()), int(index.t_us.max())
    site = random.integers(index.sites, size=count)
    inside = random.integers(begin, end + 1, size=count)
    before, after = previous_event(index, site, inside + 1), next_event(index, site, inside)
    earliest = np.where(before >= 0, index.t_us[before], begin)
    latest = np.where(after >= 0, index.t_us[after] - 1, end)
    instants = np.sort(earliest + random.random((2, count)) * (latest - earliest), 0)
    start, close = table.clock.unit(np.rint(instants).astype(np.int64))
    none = np.zeros(count, np.int64)
    return pairs_of(table, site, (start, close), (none, none)).to(device)


def _drawn(n: int, count: int, *, seed: int, step: int, stream: str) -> Int64[np.ndarray, "b"]:
    """Ranks 0 ... n-1 that a step draws."""
    count = min(count, n)
    epoch, batch = divmod(step, n // count)
    position = np.arange(batch * count, (batch + 1) * count, dtype=np.int64)
    return shuffled(position, n, seed=number(seed, 0, stream), epoch=epoch)


def pairs_between(
    table: PairTable,
    site: Int64[np.ndarray, "b"],
    first: Int64[np.ndarray, "b"],
    last: Int64[np.ndarray, "b"],
) -> EventPairs:
    """Pairs of the events at positions `first` and `last` of the same sites."""
    t_us = table.index.t_us
    start, end = table.clock.unit(t_us[first]), table.clock.unit(t_us[last])
    # The first event is the reference level; the second and those in between count.
    return pairs_of(table, site, (start, end), counts(table.index, first + 1, last + 1))


def pairs_of(
    table: PairTable,
    site: Int64[np.ndarray, "b"],
    time: tuple[np.ndarray, np.ndarray],
    darker_brighter: tuple[np.ndarray, np.ndarray],
) -> EventPairs:
    """Pairs of two times (0...1) at sites, from the numbers of OFF and ON events."""
    darker, brighter = darker_brighter
    channel = None if table.channel is None else table.channel[site].astype(np.int64)
    return EventPairs(
        xy=torch.from_numpy(table.site_xy[site]),
        track=torch.from_numpy(table.index.track_of(site)),
        start=_float(time[0]),
        end=_float(time[1]),
        negative=_float(-darker),
        positive=_float(brighter),
        channel=None if channel is None else torch.from_numpy(channel),
    )


def _float(values: Shaped[np.ndarray, "*b"]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


@dataclass(frozen=True)
class PatchShape:
    """Size of patches, their spacing, and the border they keep off."""

    side: int = 8
    """Pixels along each edge."""
    apart: tuple[int, int] = (1, 8)
    """Smallest and largest spacing in pixels, drawn for each patch."""
    border: int = 10
    """Pixels at the edge of an image that are not used."""


def draw_patches(
    table: PixelTable, count: int, shape: PatchShape, *, frames: int, seed: int, step: int
) -> Pixels:
    """Patches `[count, side, side]` of a few frames, an equal number of each.

    Frames are drawn without replacement, in a shuffled order.

    Args:
        table: The pixels to draw from.
        count: Number of patches.
        shape: Of each.
        frames: Number of frames in one step.
        seed: The run's seed.
        step: The training step.

    Raises:
        OptionError: The patches are larger than the images.
    """
    height, width = table.images.shape[1:3]
    apart = min(
        shape.apart[1], (min(height, width) - 2 * shape.border - 1) // max(shape.side - 1, 1)
    )
    if apart < 1 or min(height, width) <= 2 * shape.border:
        raise OptionError(
            "images are too small for such patches",
            got=f"{width}x{height} px, borders of {shape.border} px, {shape.side} pixels a side",
            do="take smaller patches or a narrower border",
        )
    random = numpy_generator(seed, step, "patches")
    frames = min(frames, len(table.frame))
    epoch, round_ = divmod(step, len(table.frame) // frames)
    rank = np.arange(round_ * frames, (round_ + 1) * frames, dtype=np.int64)
    order = shuffled(rank, len(table.frame), seed=number(seed, 0, "frames"), epoch=epoch)
    frame = table.frame[order[np.arange(count) * frames // count]]
    step_px = random.integers(min(shape.apart[0], apart), apart + 1, size=count)
    reach = step_px * (shape.side - 1)
    left = shape.border + (random.random(count) * (width - 2 * shape.border - reach)).astype(int)
    top = shape.border + (random.random(count) * (height - 2 * shape.border - reach)).astype(int)
    offset = np.arange(shape.side) * step_px[:, None]  # [count, side]
    row = np.broadcast_to((top[:, None] + offset)[:, :, None], (count, shape.side, shape.side))
    column = np.broadcast_to((left[:, None] + offset)[:, None], row.shape)
    which = np.broadcast_to(frame[:, None, None], row.shape).copy()
    return _pixels(table, which, row, column)
