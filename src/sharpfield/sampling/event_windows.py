"""What each camera's events say: latent frames at any time, and counts between two times.

A *window* is the time from one instant of a batch to the next. Whole events are counted exactly;
the part of an event that light was on its way at either end is estimated from the pixel's events
around it (its *phase*).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.capture import Capture, Split
from sharpfield.events.counts import counts_between
from sharpfield.events.index import EventIndex
from sharpfield.events.latent_frames import LatentFrames
from sharpfield.events.motion import EventMotion
from sharpfield.events.ramps import phase_at
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
