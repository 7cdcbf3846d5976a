"""Events from images: exact crossing times, for log intensity that is linear between two images.

`events_of` takes a sequence of images; `EventPixels` is fed one image after the other, so that a
recording of any length needs the memory of one *gap*, the time between two images. Times are
integer ns inside and us in the stream, rounded to the nearest. The result does not depend on how a
linear piece of log intensity is divided into gaps.
"""

from collections.abc import Callable, Iterator, Sequence
from math import cos, log, sqrt
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int16, Int32, Int64
from numba import njit

from sharpfield.core.capture import Known, Note, Thresholds
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.simulation.sensors.event_pixels import (
    BRIGHT_SHOT,
    DARK_SPEED,
    EventSensor,
    brightness,
    log_intensity,
    make_pixels,
)

NEVER = np.iinfo(np.int64).min
"""`ready_ns` of a pixel that is not in its dead time."""
IDEAL = EventSensor()

LONGEST_COUNT_US = 1 << 20
"""Gaps longer than this are sorted by comparison; counting would need a table of this length."""


class Spikes(NamedTuple):
    """Events of one gap in the order of pixels; a buffer that grows."""

    offset_us: Int32[np.ndarray, "n"]
    pixel: Int32[np.ndarray, "n"]
    p: Int8[np.ndarray, "n"]


class Gap(NamedTuple):
    """Events of one gap in the order of time."""

    x: Int16[np.ndarray, "n"]
    y: Int16[np.ndarray, "n"]
    t_us: Int64[np.ndarray, "n"]
    p: Int8[np.ndarray, "n"]


class EventPixels:
    """The pixels of one event camera, with their state."""

    def __init__(self, sensor: EventSensor, seed: int) -> None:
        self.sensor, self.seed = sensor, seed
        dead_ns = round(1e3 * sensor.refractory_us)
        resets = dead_ns > 0 and sensor.refractory_rule == "reset"
        noisy = bool(sensor.leak_hz or sensor.shot_hz or sensor.hot_share)
        self._rules = dead_ns, resets, noisy, sensor.leak_jitter, 1e-9 * sensor.shot_hz
        self.pixels = None
        self._size = (0, 0)
        self._last_ns = 0
        self._target = self._level = np.zeros(0)
        self._spikes = Spikes(
            np.empty(4096, np.int32), np.empty(4096, np.int32), np.empty(4096, np.int8)
        )

    def see(self, rgb: Float32[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w"], t_ns: int) -> Gap:
        """Events since the last image; none for the first.

        Args:
            rgb: Linear light, colour or grey.
            t_ns: When, in ns; must grow from call to call.

        Raises:
            OptionError: Time stands still or runs backwards.
        """
        light = brightness(rgb, self.sensor.bayer)
        target = log_intensity(light, self.sensor)
        if self.pixels is None:
            self.pixels = make_pixels(self.sensor, target, self.seed)
            self._size, self._last_ns = light.shape, t_ns
            self._target = self._level = target
            return Gap(*(np.zeros(0, d) for d in (np.int16, np.int16, np.int64, np.int8)))
        if t_ns <= self._last_ns:
            raise OptionError(
                "images must come in the order of time", got=f"{self._last_ns} ns, {t_ns} ns"
            )
        start_ns, self._last_ns = self._last_ns, t_ns
        span_ns, before = (start_ns, t_ns), self._level
        self._level = self._follow(target, light, t_ns - start_ns)
        count, self._spikes = _cross(
            self.pixels,
            (before, self._level),
            light.reshape(-1),
            span_ns,
            self._rules,
            self._spikes,
        )
        return _ordered(self._spikes, count, span_ns, self._size[1])

    def thresholds(self) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
        """Contrast thresholds of each pixel, ON and OFF; known after the first image."""
        assert self.pixels is not None, "thresholds are drawn at the first image"
        on, off = self.pixels.on.reshape(self._size), self.pixels.off.reshape(self._size)
        return on.astype(np.float32), off.astype(np.float32)

    def known(self) -> Known:
        """What a capture knows about its event camera."""
        sensor = self.sensor
        return Known(
            thresholds=Thresholds(sensor.threshold_off, sensor.threshold_on),
            refractory_us=sensor.refractory_us,
            log_floor=sensor.floor,
        )

    def notes(self) -> dict[str, Note]:
        """The thresholds of each pixel, for the notes of a capture."""
        on, off = self.thresholds()
        return {"threshold_on_map": on, "threshold_off_map": off}

    def _follow(
        self, target: Float64[np.ndarray, "n"], light: Float32[np.ndarray, "h w"], gap_ns: int
    ) -> Float64[np.ndarray, "n"]:
        """Low-passed level after a gap with log light linear to a target; exact for a ramp."""
        before, self._target = self._target, target
        if not self.sensor.cutoff_hz:
            return target
        speed = DARK_SPEED + (1 - DARK_SPEED) * np.clip(light.reshape(-1), 0, 1).astype(np.float64)
        gap = 2 * np.pi * self.sensor.cutoff_hz * speed * (1e-9 * gap_ns)  # in time constants
        passed = -np.expm1(-gap)  # step response
        lag = (target - before) / gap * passed
        return target - lag + (self._level - before) * (1 - passed)


def watch(
    render: Callable[[int], Float32[np.ndarray, "h w 3"]],
    instants_us: Int64[np.ndarray, "n"],
    *,
    most_change: float,
    shortest_us: int = 250,
    floor: float = 1e-5,
) -> Iterator[tuple[int, Float32[np.ndarray, "h w 3"]]]:
    """Images at some instants, and in between where a pixel changes too much in one gap.

    Args:
        render: Linear light at a time in us; must be a pure function.
        instants_us: Ascending.
        most_change: Largest change of log intensity of any pixel in a gap; natural log.
        shortest_us: No gap is made shorter than this.
        floor: Added to intensity before the logarithm.

    Source: adaptive sampling of ESIM (Rebecq et al., CoRL 2018).
    """
    at = int(instants_us[0])
    seen = render(at)
    yield at, seen
    for goal in instants_us[1:]:
        ahead = [(int(goal), render(int(goal)))]
        while ahead:
            t, rgb = ahead[-1]
            wide = t - at >= 2 * shortest_us
            if wide and np.abs(np.log((rgb + floor) / (seen + floor))).max() > most_change:
                middle = (at + t) // 2
                ahead.append((middle, render(middle)))
                continue
            at, seen = ahead.pop()
            yield at, seen


def joined(gaps: list[Gap], size: tuple[int, int], *, bayer: str = "") -> EventStream:
    """One stream from the events of consecutive gaps.

    Args:
        gaps: In the order of time.
        size: Width and height of the sensor.
        bayer: Its colour filter tile.
    """
    columns = [np.concatenate(column) for column in zip(*gaps, strict=True)]
    return EventStream(*columns, width=size[0], height=size[1], bayer=bayer)


def events_of(
    images: Float32[np.ndarray, "n h w 3"] | Float32[np.ndarray, "n h w"],
    times_us: Sequence[int],
    *,
    sensor: EventSensor = IDEAL,
    seed: int = 0,
) -> EventStream:
    """The events that a camera would report of images; log light is straight between two of them.

    Args:
        images: Linear light, not stored values.
        times_us: When each was seen; ascending.
        sensor: Its pixels.
        seed: Random seed of what differs from pixel to pixel, and of noise.

    Raises:
        OptionError: There are not as many times as images, or they do not ascend.
    """
    if len(images) != len(times_us) or not len(images):
        raise OptionError(
            "there must be one time for each image", got=f"{len(images)} images, {len(times_us)}"
        )
    pixels = EventPixels(sensor, seed)
    gaps = [pixels.see(one, 1000 * int(t)) for one, t in zip(images, times_us, strict=True)]
    return joined(gaps, (images.shape[2], images.shape[1]), bayer=sensor.bayer)


@njit(cache=True)
@no_type_check
def _cross(pixels, levels, light, span_ns, rules, spikes):
    """Advance all pixels over a linear piece of log intensity; collect their events.

    Args:
        pixels: See `Pixels`; their state is updated.
        levels: Where each level starts and ends.
        light: Linear intensity, which decides on shot noise.
        span_ns: Start and end.
        rules: Dead time in ns, whether its end resets the reference, whether there is leak or shot
            noise, leak jitter, and the rate of shot noise in the dark per ns.
        spikes: A buffer.

    Returns:
        Number of events, and the buffer (another one if it had to grow).
    """
    (t0, t1), (before, after) = span_ns, levels
    dead, resets, noisy, jitter, shot = rules
    duration, first_us, n = t1 - t0, (t0 + 500) // 1000, 0
    offset_us, pixel, polarity = spikes
    for i in range(len(after)):
        reference, on, off = pixels.reference[i], pixels.on[i], pixels.off[i]
        if not (noisy or resets) and reference - off < after[i] < reference + on:
            continue
        start, drift, ready = before[i], pixels.leak[i] * duration, pixels.ready_ns[i]
        if jitter > 0.0 and drift > 0.0:
            drift += jitter * sqrt(drift * on) * _normal(pixels.random, i)
        finish = after[i] + drift
        rate = shot * (1.0 - (1.0 - BRIGHT_SHOT) * min(light[i], 1.0))
        pixels.hazard[i] -= rate * duration
        if reference - off < finish < reference + on and pixels.hazard[i] > 0.0 and ready < t0:
            pixels.reference[i] = reference - drift
            continue
        now, slope = t0, (finish - start) / duration
        while True:
            if resets and ready >= now:  # held until `ready`, then compared anew
                if ready > t1:
                    break
                now, reference, ready = ready, start + slope * (ready - t0), NEVER
            when, p = _next_crossing(reference + on, reference - off, start, finish, span_ns)
            while pixels.hazard[i] <= 0.0 and t1 + pixels.hazard[i] / rate < now:
                pixels.hazard[i] -= log(1.0 - _uniform(pixels.random, i))
            if pixels.hazard[i] <= 0.0 and (p == 0 or t1 + pixels.hazard[i] / rate < when):
                when = max(now, t1 + int(pixels.hazard[i] / rate))
                p = 1 if _uniform(pixels.random, i) < 0.5 else -1
                reference = start + slope * (when - t0)
                pixels.hazard[i] -= log(1.0 - _uniform(pixels.random, i))
            elif p == 0:
                break
            else:
                reference += on if p > 0 else -off
            now = when
            if now < ready:
                continue
            if n == len(pixel):
                offset_us, pixel = _longer(offset_us), _longer(pixel)
                polarity = _longer(polarity)
            offset_us[n], pixel[n], polarity[n] = (now + 500) // 1000 - first_us, i, p
            n += 1
            ready = now + dead if dead > 0 else NEVER
        pixels.reference[i], pixels.ready_ns[i] = reference - drift, ready
    return n, Spikes(offset_us, pixel, polarity)


@njit(cache=True)
@no_type_check
def _next_crossing(above, below, start, finish, span_ns):
    """When a line first crosses a threshold, and which; polarity 0 for never."""
    t0, t1 = span_ns
    if finish > start and finish >= above:
        share, p = (above - start) / (finish - start), 1
    elif finish < start and finish <= below:
        share, p = (below - start) / (finish - start), -1
    else:
        return t1, 0
    return t0 + int(max(share, 0.0) * (t1 - t0) + 0.5), p


@njit(cache=True)
@no_type_check
def _longer(column):
    """The same column with twice the capacity."""
    longer = np.empty(2 * len(column), column.dtype)
    longer[: len(column)] = column
    return longer


@njit(cache=True)
@no_type_check
def _uniform(random, i):
    """The next number 0...1 of a pixel's own generator (splitmix64)."""
    random[i] += np.uint64(0x9E3779B97F4A7C15)
    z = random[i]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return float((z ^ (z >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True)
@no_type_check
def _normal(random, i):
    """A standard normal number (Box and Muller)."""
    radius = sqrt(-2.0 * log(1.0 - _uniform(random, i)))
    return radius * cos(6.283185307179586 * _uniform(random, i))


def _ordered(spikes: Spikes, count: int, span_ns: tuple[int, int], width: int) -> Gap:
    """Sort by time; equal times stay in the order of pixels."""
    first_us, last_us = (span_ns[0] + 500) // 1000, (span_ns[1] + 500) // 1000
    if last_us - first_us > LONGEST_COUNT_US:
        order = np.argsort(spikes.offset_us[:count], kind="stable")
    else:
        order = _count_order(spikes.offset_us, count, last_us - first_us + 1)
    return Gap(*_take(spikes, order, first_us, width))


@njit(cache=True)
@no_type_check
def _count_order(offset_us, count, length):
    """A stable order by counting how many events fall on each us."""
    place = np.zeros(length + 1, np.int64)
    for k in range(count):
        place[offset_us[k] + 1] += 1
    for k in range(length):
        place[k + 1] += place[k]
    order = np.empty(count, np.int64)
    for k in range(count):
        order[place[offset_us[k]]] = k
        place[offset_us[k]] += 1
    return order


@njit(cache=True)
@no_type_check
def _take(spikes, order, first_us, width):
    """Columns of a stream in a given order."""
    n = len(order)
    x, y = np.empty(n, np.int16), np.empty(n, np.int16)
    t, p = np.empty(n, np.int64), np.empty(n, np.int8)
    for k in range(n):
        i = order[k]
        y[k] = spikes.pixel[i] // width
        x[k] = spikes.pixel[i] - width * (spikes.pixel[i] // width)
        t[k] = first_us + spikes.offset_us[i]
        p[k] = spikes.p[i]
    return x, y, t, p
