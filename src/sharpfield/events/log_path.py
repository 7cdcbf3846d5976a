"""The change of log light of every pixel over an exposure, integrated from its events.

Each event changes the log light of its pixel by one threshold. A *path* is that change over one
exposure: its value at some instants, and the time average of exp(change) over the exposure, which
is the factor between a blurred and a sharp pixel. Light is taken as constant between events, so the
average is a finite sum and exact: there are no time slices.

Events act on one channel, which stands for all colours, or, behind a colour filter, on the colour
of that filter: the change of a colour is then interpolated from the pixels that have its filter, as
in bilinear demosaicing, since the change of log light is smooth where light itself is not.
Rectified positions act on the four pixels around them.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int8, Int64
from numba import njit
from torch import Tensor

from sharpfield.core.events import EventStream
from sharpfield.events.threshold import FixedThresholds

GREEN = 1
SEEN = 1e-3
"""Total weight of all sites below which a pixel counts as reached by none."""


@dataclass(frozen=True)
class LogPath:
    """Change of log light during one exposure, relative to its opening. c is 1 or 3."""

    log_mean: Float[Tensor, "h w c"]
    """Log of the time average of exp(change) over the exposure."""
    change: Float[Tensor, "k h w c"]
    """At each of the instants."""


@dataclass(frozen=True)
class Spread:
    """How the change of log light at sites is distributed to the pixels of the image."""

    coverage: Float64[np.ndarray, "h w c"]
    """Sum of the weights of all sites at each pixel, by which weights are divided."""
    reach: int
    """Pixels to each side that a site acts on: 1, or 2 where colours must be interpolated."""

    @property
    def size(self) -> tuple[int, int, int]:
        """Height, width, channels."""
        height, width, channels = self.coverage.shape
        return height, width, channels


def pixel_spread(*, width: int, height: int) -> Spread:
    """Mono sensor: a site is a pixel, or distributes its change to the four pixels around it."""
    return Spread(np.ones((height, width, 1)), reach=1)


def site_spread(
    site_xy: Float32[np.ndarray, "m 2"],
    channel: Int8[np.ndarray, "m"] | None,
    *,
    width: int,
    height: int,
) -> Spread:
    """A known set of sites: every pixel gets the weighted mean of the sites around it.

    Args:
        site_xy: Column and row of all sites, in index units.
        channel: 0 red, 1 green or 2 blue for each; None on a mono sensor. With colours, the mean
            is bilinear interpolation in each colour's own lattice.
        width: Of the image.
        height: Of the image.
    """
    channels, reach = (1, 1) if channel is None else (3, 2)
    sites = _Steps(
        t_us=np.zeros(len(site_xy), np.int64),
        xy=site_xy,
        colour=np.zeros(len(site_xy), np.int8) if channel is None else channel,
        step=np.ones(len(site_xy)),
    )
    unweighted = Spread(np.ones((height, width, channels)), reach)
    total = _Progress.at_rest(unweighted, 0).after(sites, unweighted).level
    return Spread(np.where(total < SEEN, np.inf, total), reach)


def exposure_path(
    events: EventStream,
    window_us: tuple[int, int],
    instants_us: Int64[np.ndarray, "k"],
    thresholds: FixedThresholds,
    spread: Spread,
    *,
    channel: Int8[np.ndarray, "n"] | None = None,
) -> LogPath:
    """The path of every pixel over one exposure.

    Args:
        events: At least those of the exposure.
        window_us: Opening and closing of the shutter. At a single instant nothing changes.
        instants_us: When to report the change; ascending, inside the exposure.
        thresholds: For each sign.
        spread: From `pixel_spread` or `site_spread`.
        channel: Colour of each event of `events`; required when `spread` has colours.
    """
    opens, closes = window_us
    steps = _steps(events, window_us, thresholds, channel)
    progress = _Progress.at_rest(spread, opens)
    change = np.empty((len(instants_us), *spread.size))
    begin = 0
    for k, instant in enumerate(instants_us):
        end = int(np.searchsorted(steps.t_us, int(instant), side="right"))
        progress = progress.after(steps[begin:end], spread)
        change[k], begin = progress.level, end
    log_mean = progress.after(steps[begin:], spread).log_mean(opens, closes)
    return LogPath(_tensor(log_mean), _tensor(change))


def change_between(
    events: EventStream,
    window_us: tuple[int, int],
    thresholds: FixedThresholds,
    spread: Spread,
    *,
    channel: Int8[np.ndarray, "n"] | None = None,
) -> Float[Tensor, "h w c"]:
    """Change of log light from after the first time up to and including the second."""
    steps = _steps(events, window_us, thresholds, channel)
    progress = _Progress.at_rest(spread, window_us[0]).after(steps, spread)
    return _tensor(progress.level)


def _tensor(values: Float64[np.ndarray, "*b"]) -> Float[Tensor, "*b"]:
    return torch.as_tensor(values, dtype=torch.float32)


@dataclass(frozen=True)
class _Steps:
    """Events as steps of log light at positions."""

    t_us: Int64[np.ndarray, "n"]
    xy: Float32[np.ndarray, "n 2"]
    colour: Int8[np.ndarray, "n"]
    step: Float64[np.ndarray, "n"]

    def __getitem__(self, part: slice) -> "_Steps":
        return _Steps(self.t_us[part], self.xy[part], self.colour[part], self.step[part])


def _steps(
    events: EventStream,
    window_us: tuple[int, int],
    thresholds: FixedThresholds,
    channel: Int8[np.ndarray, "n"] | None,
) -> _Steps:
    """The events after the first time up to and including the second."""
    first, last = np.searchsorted(events.t_us, window_us, side="right")
    part = slice(int(first), int(last))
    inside = events[part]
    return _Steps(
        t_us=np.asarray(inside.t_us),
        xy=np.stack([inside.x, inside.y], -1).astype(np.float32),
        colour=np.zeros(len(inside), np.int8) if channel is None else channel[part],
        step=np.where(inside.p > 0, thresholds.positive, -thresholds.negative),
    )


@dataclass(frozen=True)
class _Progress:
    """State of the integration at every pixel."""

    level: Float64[np.ndarray, "h w c"]
    """Change of log light since the beginning."""
    area: Float64[np.ndarray, "h w c"]
    """Integral of exp(level) over time, up to `since`."""
    since_us: Int64[np.ndarray, "h w c"]
    """Time of the pixel's latest step."""

    @staticmethod
    def at_rest(spread: Spread, begin_us: int) -> "_Progress":
        return _Progress(
            np.zeros(spread.size), np.zeros(spread.size), np.full(spread.size, begin_us, np.int64)
        )

    def after(self, steps: _Steps, spread: Spread) -> "_Progress":
        """The state after some more steps, in order of time."""
        level, area, since = self.level.copy(), self.area.copy(), self.since_us.copy()
        weights = (spread.reach, spread.coverage)
        _integrate(steps.t_us, steps.xy, steps.colour, steps.step, weights, level, area, since)
        return _Progress(level, area, since)

    def log_mean(self, begin_us: int, end_us: int) -> Float64[np.ndarray, "h w c"]:
        """Log of the time average of exp(level); zero over no time at all."""
        if end_us == begin_us:
            return np.zeros_like(self.area)
        area = self.area + np.exp(self.level) * (end_us - self.since_us)
        return np.log(area / (end_us - begin_us))


@njit(cache=True, nogil=True)
@no_type_check
def _integrate(t_us, xy, colour, step, weights, level, area, since):
    reach, coverage = weights
    for i in range(t_us.size):
        x, y, c = xy[i, 0], xy[i, 1], colour[i]
        left, top = int(np.floor(x)) + 1 - reach, int(np.floor(y)) + 1 - reach
        for row in range(max(top, 0), min(top + 2 * reach, level.shape[0])):
            for column in range(max(left, 0), min(left + 2 * reach, level.shape[1])):
                weight = _weight(x - column, y - row, reach, c)
                if weight > 0:
                    at = row, column, c
                    area[at] += np.exp(level[at]) * (t_us[i] - since[at])
                    since[at] = t_us[i]
                    level[at] += step[i] * weight / coverage[at]


@njit(cache=True, nogil=True)
@no_type_check
def _weight(dx, dy, reach, colour):
    """Bilinear weight in the lattice of the site's colour.

    The lattice is all pixels on a mono sensor, every second one in both directions for red and
    blue, and a checkerboard for green.
    """
    if reach == 2 and colour == GREEN:
        dx, dy = dx + dy, dx - dy
    return max(0.0, 1 - abs(dx) / reach) * max(0.0, 1 - abs(dy) / reach)
