"""Events of each camera in windows of time: of all its pixels for views, or of random pixels.

A *window* is a pixel and two instants; its counts are those of the events after the first instant
up to and including the second. For views, the part of an event that light was on its way at either
end is estimated from the pixel's events around it (its *phase*). Windows of random pixels have a
log-uniform length, so that short ones are as frequent as long ones. A *span* is a window that
begins and ends with an event of its pixel. At these instants the reference level of the pixel
equals its log light, so that the counts of a span measure the change of light exactly, while at the
ends of other windows there is an unknown rest of up to a threshold.

Source: EvDNeRF (WACV 2024) for windows of half event pixels and half random pixels over all views;
Robust e-NeRF (ICCV 2023) for reference levels.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.capture import Capture, Split
from sharpfield.core.measurements import EventPairs
from sharpfield.core.seed import numpy_generator
from sharpfield.events.counts import EventMotion, counts_between
from sharpfield.events.index import EventIndex, chain_start, counts, window
from sharpfield.events.latent_frames import LatentFrames
from sharpfield.events.ramps import phase_at
from sharpfield.sampling.pixels_and_pairs import Device, PairTable, pairs_between, pairs_of
from sharpfield.storage.event_cache import event_index

ROUNDING = 0.5
"""Events that a count may be off by at an end where the phase of the pixel is unknown."""

Times = Int64[np.ndarray, "_"]


@dataclass(frozen=True)
class CameraEvents:
    """The events of one camera, and what they make of its frames."""

    motion: EventMotion
    index: EventIndex | None
    """By pixel; None where positions are rectified or pixels sit behind a colour filter."""
    latent: LatentFrames | None
    """Latent frames by the event double integral; None without training frames of this camera."""


def camera_events(capture: Capture, *, latent: bool) -> dict[int, CameraEvents]:
    """The events of each camera that reported any, by its track.

    Args:
        capture: With events; those of a rolling shutter on the clock of its first row.
        latent: Whether to prepare latent frames, too, where the motion of the camera is known.
    """
    events = capture.needed_events
    latent &= capture.frames is not None and capture.known.motion != "unknown"
    found: dict[int, CameraEvents] = {}
    for track in range(events.tracks):
        alone = with_events_of(capture, track)
        if not len(alone.needed_events):
            continue
        motion = EventMotion.of(alone)
        exact = motion.channel is None and not motion.events.rectified
        index = event_index(motion.events) if exact else None
        frames = _frames_of_track(alone, track) if latent else None
        images = None if frames is None else LatentFrames(frames, motion, index)
        found[track] = CameraEvents(motion, index, images)
    return found


def with_events_of(capture: Capture, track: int) -> Capture:
    """The capture with the events of one of its cameras alone."""
    events = capture.needed_events
    if events.tracks == 1 and track == 0:
        return capture
    own = events.of_track(track)
    return replace(capture, events=replace(own, track=None, tracks=1))


def counts_in_windows(
    camera: CameraEvents, times_us: Times
) -> tuple[Float[Tensor, "q h w c"], Float[Tensor, "q h w c"], Float[Tensor, "q h w c"]]:
    """Events of one camera between instants: to darker, to brighter, and their rounding.

    On a colour sensor every pixel has one measurement for each of c = 3 colours, interpolated from
    the pixels behind that filter.

    Args:
        camera: Whose events.
        times_us: Ascending; q + 1 of them make q windows.

    Returns:
        Minus the number of events to darker, the number to brighter, and by how many events they
        may be off because whole events were counted.
    """
    counted = [
        counts_between(camera.motion, int(start), int(end))
        for start, end in zip(times_us[:-1], times_us[1:], strict=True)
    ]
    negative, positive = (torch.stack(part) for part in zip(*counted, strict=True))
    if camera.index is None:
        return negative, positive, ((negative == 0) & (positive == 0)).float()
    events = camera.motion.events
    size = {"width": events.width, "height": events.height}
    found = [phase_at(camera.index, int(time), **size) for time in times_us]
    phase = torch.stack([phase for phase, _ in found])[..., None]  # [q + 1, h, w, 1]
    unknown = torch.stack([~known for _, known in found])[..., None].float()
    negative = negative + phase[1:].clamp_max(0) - phase[:-1].clamp_max(0)
    positive = positive + phase[1:].clamp_min(0) - phase[:-1].clamp_min(0)
    return negative, positive, ROUNDING * (unknown[1:] + unknown[:-1])


def _frames_of_track(capture: Capture, track: int) -> Capture | None:
    """The capture with only the training frames of one camera; None if it has none."""
    train = capture.split.train
    own = train[capture.needed_frames.track[train] == track]
    return replace(capture, split=Split(own, capture.split.test)) if len(own) else None


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
