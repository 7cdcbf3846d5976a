"""What frames say happened between two exposures, and what events say of the same.

The events of a pixel between the openings of two shutters, and those during both exposures, say
what the ratio of the two blurred values is:

    log B_j - log B_i  =  E(open_j) - E(open_i)  +  m_j - m_i

with E the change of log light since a first instant and m the log of the mean of exp(E) over an
exposure, relative to its opening (see `formation.edi`). Nothing has to be sharp, and no scene has
to be known. One equation belongs to one *site*, a place that reports events.

Two things make counts of events fall behind the light; both are made part of the equations.

- After its last event the light went on by a part of a threshold, most often the same way. So the
  equation also holds the sign of the last event and that of the next one, averaged over each
  exposure: its *surroundings*.
- A pixel is blind for its dead time after an event. Of two events of one sign that are `dt` apart,
  the second stands for `dt / (dt - dead time)` thresholds.
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
from sharpfield.events.double_integral import FLOOR
from sharpfield.events.index import EventIndex, first_since
from sharpfield.events.site_colour import site_channels
from sharpfield.preparation.thresholds import BRIGHT, DARK, linear_light, neighbours

MOST_WEIGHT = 4.0
"""An event right after a dead time stands for no more thresholds than this."""


@dataclass(frozen=True)
class ExposurePair:
    """Two exposures of one camera, and what its frames say of them."""

    frames: tuple[int, int]
    """The earlier and the later one."""
    windows_us: Int64[np.ndarray, "2 2"]
    """Opening and closing of each."""
    change: Float64[np.ndarray, "h w c"]
    """log B_j - log B_i: of luma, or of each colour behind a colour filter."""
    usable: Bool[np.ndarray, "h w c"]
    """Where both values are neither too dark nor saturated."""

    def later(self, by_us: int) -> "ExposurePair":
        """The same images, taken at another time."""
        return ExposurePair(self.frames, self.windows_us + by_us, self.change, self.usable)


@dataclass(frozen=True)
class ReaderOptions:
    """What the events of each site tell of one pair."""

    expected: Float64[np.ndarray, "m"]
    """Change of log light, as far as events count."""
    count: Float64[np.ndarray, "m 2"]
    """Thresholds crossed to darker and to brighter, between the two openings."""
    last: Float64[np.ndarray, "m"]
    """Mean sign of the last event, of the second exposure minus the first."""
    next: Float64[np.ndarray, "m"]
    """And of the next event."""


def exposure_pairs(
    capture: Capture, *, most: int, encoding: str | None = None
) -> list[ExposurePair]:
    """Pairs of consecutive exposures whose events are all there, spread over the capture.

    Args:
        capture: With frames and events.
        most: How many pairs.
        encoding: How stored values relate to light, if not as the frames say.

    Raises:
        CaptureError: There are no events, or not two frames of one camera.
    """
    frames, events = capture.needed_frames, capture.needed_events
    pairs = neighbours(capture, np.arange(len(frames)))
    if not len(pairs) or not len(events):
        raise CaptureError(
            "comparing frames with events needs two frames of one camera, and events",
            where=capture.name,
            got=f"{len(frames)} frames, {len(events)} events",
        )
    opens, closes = frames.exposure.open_us[pairs[:, 0]], frames.exposure.close_us[pairs[:, 1]]
    inside = pairs[(opens >= events.t_us[0]) & (closes <= events.t_us[-1])]
    chosen = evenly_spread(inside if len(inside) else pairs, most)
    tone = tone_of(encoding or frames.encoding)
    return [_pair(capture, (int(i), int(j)), tone) for i, j in chosen]


def at_sites(
    values: Shaped[np.ndarray, "h w c"],
    capture: Capture,
    index: EventIndex,
    sites: Int64[np.ndarray, "m"],
) -> Shaped[np.ndarray, "m"]:
    """A map over the pixels, looked up at some sites: the nearest pixel, the site's colour."""
    x, y = np.rint(index.site_xy[sites]).astype(np.int64).T
    height, width, _ = values.shape
    channels = site_channels(capture.needed_events, index)
    channel = np.zeros(len(sites), np.int64) if channels is None else channels[sites]
    return values[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1), channel]


def told(
    index: EventIndex,
    weight: Float64[np.ndarray, "n"],
    pair: ExposurePair,
    sites: Int64[np.ndarray, "m"],
    thresholds: tuple[float, float],
) -> ReaderOptions:
    """What the events of some sites tell of a pair.

    Args:
        index: All events by site.
        weight: Thresholds that each event of the index stands for.
        pair: The two exposures.
        sites: Of the camera that exposed.
        thresholds: To darker and to brighter.
    """
    found = np.zeros((len(sites), 5))
    _tell(*(sites, index.offset, index.t_us, index.p, weight, pair.windows_us, thresholds, found))
    return ReaderOptions(found[:, 0], found[:, 1:3], found[:, 3], found[:, 4])


def weights(index: EventIndex, dead_us: float) -> Float64[np.ndarray, "n"]:
    """Thresholds that each event stands for, if pixels are blind for a time after an event."""
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
                if apart > dead_us:  # what comes sooner has not been told by that rule
                    weight[i] = min(apart / (apart - dead_us), MOST_WEIGHT)


@njit(cache=True, nogil=True)
@no_type_check
def _tell(sites, offset, t_us, p, weight, windows_us, thresholds, found):
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
