"""The change of log light between two exposures, by the frames and by the events.

The events of a pixel between the openings of two shutters, and those during both exposures,
predict the ratio of the two blurred values:

    log B_j - log B_i  =  E(open_j) - E(open_i)  +  m_j - m_i

with E the change of log light since a reference time and m the log of the mean of exp(E) over an
exposure, relative to its opening (see `events.edi`). Neither a sharp image nor a scene is needed.
Each *site*, a position that reports events, gives one equation.

Two effects make event counts smaller than the change of light; both are terms of the equations.

- Since its last event the light has changed by a part of a threshold, most often in the same
  direction. So the equation also has the polarity of the last event and of the next one, averaged
  over each exposure.
- A pixel is blind for its refractory time after an event. Of two events of one polarity that are
  `dt` apart, the second counts for `dt / (dt - refractory time)` thresholds.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float64, Int64, Shaped
from numba import njit

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import Tone, luma, tone_of
from sharpfield.events.counts import site_channels
from sharpfield.events.double_integral import FLOOR
from sharpfield.events.index import EventIndex, first_since
from sharpfield.preparation.thresholds import BRIGHT, DARK, consecutive_pairs, linear_light

MAX_WEIGHT = 4.0
"""Most thresholds that an event right after a refractory time counts for."""


@dataclass(frozen=True)
class ExposurePair:
    """Two exposures of one camera, and the change between them by its frames."""

    frames: tuple[int, int]
    """Indices of the earlier and the later frame."""
    windows_us: Int64[np.ndarray, "2 2"]
    """Opening and closing time of each."""
    change: Float64[np.ndarray, "h w c"]
    """log B_j - log B_i: of luma, or of each colour behind a colour filter."""
    usable: Bool[np.ndarray, "h w c"]
    """Where both values are neither too dark nor saturated."""

    def shifted(self, by_us: int) -> "ExposurePair":
        """The same images with later times."""
        return ExposurePair(self.frames, self.windows_us + by_us, self.change, self.usable)


@dataclass(frozen=True)
class EventChange:
    """The change at each site between the exposures of a pair, by the events."""

    expected: Float64[np.ndarray, "m"]
    """Change of log light, without the part since the last event."""
    count: Float64[np.ndarray, "m 2"]
    """Thresholds crossed to darker and to brighter between the two openings."""
    last: Float64[np.ndarray, "m"]
    """Mean polarity of the last event, second exposure minus first."""
    next: Float64[np.ndarray, "m"]
    """Mean polarity of the next event, second exposure minus first."""


def find_exposure_pairs(capture: Capture, *, most: int) -> list[ExposurePair]:
    """Pairs of consecutive exposures that are covered by events, spread over the capture.

    Raises:
        CaptureError: There are no events, or not two frames of one camera.
    """
    frames, events = capture.needed_frames, capture.needed_events
    pairs = consecutive_pairs(capture, np.arange(len(frames)))  # [m, 2]
    if not len(pairs) or not len(events):
        raise CaptureError(
            "comparing frames with events needs two frames of one camera, and events",
            where=capture.name,
            got=f"{len(frames)} frames, {len(events)} events",
        )
    opens, closes = frames.exposure.open_us[pairs[:, 0]], frames.exposure.close_us[pairs[:, 1]]
    inside = pairs[(opens >= events.t_us[0]) & (closes <= events.t_us[-1])]
    chosen = evenly_spread(inside if len(inside) else pairs, most)
    tone = tone_of(frames.encoding)
    return [_pair(capture, (int(i), int(j)), tone) for i, j in chosen]


def at_sites(
    values: Shaped[np.ndarray, "h w c"],
    capture: Capture,
    index: EventIndex,
    sites: Int64[np.ndarray, "m"],
) -> Shaped[np.ndarray, "m"]:
    """Values of a map at some sites: at the nearest pixel, in the colour of the site."""
    x, y = np.rint(index.site_xy[sites]).astype(np.int64).T
    height, width, _ = values.shape
    channels = site_channels(capture.needed_events, index)
    channel = np.zeros(len(sites), np.int64) if channels is None else channels[sites]
    return values[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1), channel]


def change_by_events(
    index: EventIndex,
    weight: Float64[np.ndarray, "n"],
    pair: ExposurePair,
    sites: Int64[np.ndarray, "m"],
    thresholds: tuple[float, float],
) -> EventChange:
    """The change at some sites between the exposures of a pair, by the events.

    Args:
        index: All events by site.
        weight: Number of thresholds that each event of the index counts for.
        pair: The two exposures.
        sites: Sites of the camera of the frames.
        thresholds: To darker and to brighter.
    """
    found = np.zeros((len(sites), 5))  # change, count off, count on, last, next
    _sum_events(
        *(sites, index.offset, index.t_us, index.p, weight, pair.windows_us, thresholds, found)
    )
    return EventChange(found[:, 0], found[:, 1:3], found[:, 3], found[:, 4])


def weights(index: EventIndex, dead_us: float) -> Float64[np.ndarray, "n"]:
    """Number of thresholds that each event counts for, given the refractory time of the pixels."""
    found = np.ones(len(index))
    if dead_us > 0:
        _weigh(index.offset, index.t_us, index.p, dead_us, found)
    return found


def _pair(capture: Capture, frames: tuple[int, int], tone: Tone) -> ExposurePair:
    light = [linear_light(capture, i, tone) for i in frames]
    if not capture.needed_events.coloured:
        light = [luma(one)[..., None] for one in light]
    first, second = (one.double().numpy() for one in light)
    usable = (np.minimum(first, second) > DARK) & (np.maximum(first, second) < BRIGHT)
    windows = np.array([capture.needed_frames.exposure.window(i) for i in frames], np.int64)
    return ExposurePair(frames, windows, np.log(second + FLOOR) - np.log(first + FLOOR), usable)


@njit(cache=True, nogil=True)
@no_type_check
def _weigh(offset, t_us, p, dead_us, weight):
    for site in range(len(offset) - 1):
        for i in range(offset[site] + 1, offset[site + 1]):
            if p[i] == p[i - 1]:
                apart = t_us[i] - t_us[i - 1]
                if apart > dead_us:  # an event within the refractory time contradicts the model
                    weight[i] = min(apart / (apart - dead_us), MAX_WEIGHT)


@njit(cache=True, nogil=True)
@no_type_check
def _sum_events(sites, offset, t_us, p, weight, windows_us, thresholds, found):
    for site in range(len(sites)):
        first, last = offset[sites[site]], offset[sites[site] + 1]
        start = first_since(t_us, first, last, windows_us[0, 0] + 1)
        end = first_since(t_us, start, last, windows_us[1, 0] + 1)
        for i in range(start, end):
            sign = 1 if p[i] > 0 else 0
            found[site, 1 + sign] += weight[i]
            found[site, 0] += p[i] * weight[i] * thresholds[sign]
        for exposure in range(2):
            opens, closes = windows_us[exposure]
            side = 1 if exposure == 1 else -1
            event = start if exposure == 0 else end
            level, area, now = 0.0, 0.0, opens
            before, after = 0.0, 0.0
            while True:
                until = t_us[event] if event < last else closes
                until = min(until, closes)
                lasts = until - now if closes > opens else 1
                light = math.exp(level) * lasts
                area += light
                before += light * (p[event - 1] if event > first else 0)
                after += light * (p[event] if event < last else 0)
                now = until
                if now >= closes:
                    break
                sign = 1 if p[event] > 0 else 0
                level += p[event] * weight[event] * thresholds[sign]
                event += 1
            length = closes - opens if closes > opens else 1
            found[site, 0] += side * np.log(area / length)
            found[site, 3] += side * before / area
            found[site, 4] += side * after / area
