"""Regression of thresholds and other parameters of the sensor on frames and events.

Every pixel of every pair of exposures gives one equation (see `exposure_pairs`). Its left side is
the change by the frames, its right side depends on the *terms*: both thresholds, the drift per
pair, the change since the last event and until the next one, the latency of events, and the
refractory time.

Both sides have errors: events have noise, pixels differ in their thresholds, and counts leave a
part of a threshold open. An ordinary regression would find thresholds that are too low (attenuation
bias). The errors of neighbouring pixels are independent, though, while the light that they see is
not: so the *slope* of each equation uses the mean slope of the pixels around it as its *instrument*
(instrumental variables).

The residual of a pixel with many events is larger, because its own threshold differs from the
common one: the spread of residuals is a function of the number of events. Equations beyond a few
such deviations get no weight (Tukey's biweight), so that hot and saturated pixels and moving
shadows do not matter.

Sources: Wang et al., "Event camera calibration of per-pixel biased contrast threshold" (ACRA 2019)
for regressing log intensity on counts; Reiersol (1941) for instruments; Beaton and Tukey (1974)
for the weights.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.seed import numpy_generator
from sharpfield.events.index import EventIndex
from sharpfield.events.threshold_search import HIGHEST, LOWEST, USUAL
from sharpfield.preparation.calibrate.exposure_pairs import (
    ExposurePair,
    at_sites,
    change_by_events,
    weights,
)

NEGATIVE, POSITIVE, DRIFT, LAST, NEXT, LATE_MS, DEAD_US = range(7)
"""Index of each term."""
TERMS = 7
START = np.array([USUAL, USUAL, 0.0, 0.0, 0.0, 0.0, 0.0])
THRESHOLD_STEP, LATE_STEP_MS, DEAD_STEP_US = 0.02, 1.0, 40.0
"""Steps of the finite differences that give the slopes."""

EARLIEST_MS, LATEST_MS = -5.0, 20.0
"""Range of the latency: events are late by the bandwidth of the pixels, and hardly early."""
SHORTEST_QUANTILE, DEAD_SHARE = 0.002, 0.8
"""The refractory time is at most `DEAD_SHARE` of this quantile of the intervals between events."""

TUKEY = 4.7
"""Residuals beyond so many standard deviations get no weight."""
TILE = 16
"""Side of a tile in px: equations are chosen and resampled by whole tiles."""
LEVELS = 8
"""Levels of the number of events at which the spread of residuals is estimated."""
RESAMPLES = 200
"""Bootstrap samples."""


@dataclass(frozen=True)
class Equations:
    """The equations of all usable sites of each pair, or of some tiles if there are too many."""

    index: EventIndex
    pairs: list[ExposurePair]
    sites: list[Int64[np.ndarray, "_"]]
    """Sites with an equation, of each pair."""
    pixel: list[Int64[np.ndarray, "_"]]
    """Row-major pixel index of each."""
    size: tuple[int, int]
    """Width and height in px."""
    change: Float64[np.ndarray, "e"]
    """Change of log light by the frames."""
    tile: Int64[np.ndarray, "e"]
    """Number of the tile of each equation."""

    @classmethod
    def of(
        cls,
        capture: Capture,
        index: EventIndex,
        pairs: list[ExposurePair],
        *,
        without: Bool[np.ndarray, "h w"],
        most: int | None = None,
    ) -> "Equations":
        """Set up the equations.

        Args:
            capture: With frames and events.
            index: All events by site.
            pairs: Pairs of exposures.
            without: Pixels to leave out.
            most: Approximate number of equations; all if not given.
        """
        width, height = capture.camera.size
        across, down = -(-width // TILE), -(-height // TILE)
        share = 1.0 if most is None else most / (len(pairs) * width * height)
        draw = numpy_generator(0, 0, "equations")
        kept, pixels, changes, tiles = [], [], [], []
        for number, pair in enumerate(pairs):
            own = index.sites_of(int(capture.needed_frames.track[pair.frames[0]]))
            x, y = np.rint(index.site_xy[own]).astype(np.int64).T
            x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
            tile = y // TILE * across + x // TILE
            chosen = draw.permutation(across * down) < max(share * across * down, 1)
            good = at_sites(pair.usable, capture, index, own) & chosen[tile] & ~without[y, x]
            kept.append(own[good])
            pixels.append((y * width + x)[good])
            changes.append(at_sites(pair.change, capture, index, own[good]))
            tiles.append(number * across * down + tile[good])
        return cls(
            *(index, pairs, kept, pixels, (width, height)),
            np.concatenate(changes),
            np.concatenate(tiles),
        )

    def subset(self, good: Bool[np.ndarray, "e"]) -> "Equations":
        """The equations where `good` is true."""
        parts = np.split(good, np.cumsum([len(sites) for sites in self.sites])[:-1])
        return replace(
            self,
            sites=[one[part] for one, part in zip(self.sites, parts, strict=True)],
            pixel=[one[part] for one, part in zip(self.pixel, parts, strict=True)],
            change=self.change[good],
            tile=self.tile[good],
        )

    def by_events(self, terms: Float64[np.ndarray, "7"]) -> Float64[np.ndarray, "e 5"]:
        """Columns: change by events, counts to darker and to brighter, last and next polarity."""
        weight = weights(self.index, float(terms[DEAD_US]))
        thresholds = float(terms[NEGATIVE]), float(terms[POSITIVE])
        late_us = round(1000 * float(terms[LATE_MS]))
        found = []
        for pair, sites in zip(self.pairs, self.sites, strict=True):
            one = change_by_events(self.index, weight, pair.shifted(late_us), sites, thresholds)
            found.append(np.column_stack([one.expected, one.count, one.last, one.next]))
        return np.concatenate(found)

    def neighbour_mean(self, values: Float64[np.ndarray, "e c"]) -> Float64[np.ndarray, "e c"]:
        """Mean over the eight neighbours of each pixel that have an equation."""
        width, height = self.size
        found, first = np.empty_like(values), 0
        for pixel in self.pixel:
            part = slice(first, first + len(pixel))
            first = part.stop
            many = _neighbours(np.ones(len(pixel)), pixel, width, height)
            for column in range(values.shape[1]):
                total = _neighbours(values[part, column], pixel, width, height)
                found[part, column] = total / np.maximum(many, 1)
        return found


@dataclass(frozen=True)
class Fit:
    """Residuals of the equations at some values of the terms."""

    terms: Float64[np.ndarray, "7"]
    expected: Float64[np.ndarray, "e"]
    residual: Float64[np.ndarray, "e"]
    """Change by the frames minus the expected one."""
    spread: Float64[np.ndarray, "e"]
    """Standard deviation of the residual for the number of events of each equation."""
    quiet: float
    """The same for an equation without events."""

    @classmethod
    def at(cls, equations: Equations, terms: Float64[np.ndarray, "7"]) -> "Fit":
        """Evaluate the equations."""
        events = equations.by_events(terms)
        expected = events[:, 0] + terms[DRIFT] + events[:, 3:] @ terms[[LAST, NEXT]]
        residual = equations.change - expected
        activity = _activity(events, terms)
        noise, growth = _spread(residual, activity)
        spread = np.sqrt(noise + growth * activity)
        return cls(terms, expected, residual, spread, float(np.sqrt(noise)))

    @property
    def explained(self) -> float:
        """Correlation of the changes by the frames with the expected ones."""
        change = self.residual + self.expected
        if len(change) < 2 or change.std() == 0 or self.expected.std() == 0:
            return 0.0
        return float(np.corrcoef(change, self.expected)[0, 1])


@dataclass(frozen=True)
class Normal:
    """The normal equations of each tile, which give a step and, resampled, the uncertainty."""

    matrix: Float64[np.ndarray, "t 7 7"]
    right: Float64[np.ndarray, "t 7"]

    @classmethod
    def of(cls, equations: Equations, fit: Fit) -> "Normal":
        """Sum the products of instruments and slopes, and of instruments and residuals."""
        slopes, activity = _slopes(equations, fit.terms)
        instruments = equations.neighbour_mean(slopes)
        instruments[:, DRIFT] = 1.0
        noise = fit.quiet**2
        growth = _spread(fit.residual, _activity(equations.by_events(fit.terms), fit.terms))[1]
        tukey = (1 - np.clip(np.abs(fit.residual) / (TUKEY * fit.spread), 0, 1) ** 2) ** 2
        weighted = (tukey / (noise + growth * activity))[:, None] * instruments
        order = np.argsort(equations.tile, kind="stable")  # sums by tile: [e, 7] -> [t, 7]
        first = np.flatnonzero(np.diff(equations.tile[order], prepend=-1))
        matrix = np.stack(
            [
                np.add.reduceat((weighted * slopes[:, [term]])[order], first)
                for term in range(TERMS)
            ],
            -1,
        )
        return cls(matrix, np.add.reduceat((weighted * fit.residual[:, None])[order], first))

    def step(
        self,
        terms: Float64[np.ndarray, "7"],
        longest_us: float,
        times: Int64[np.ndarray, "t"] | None = None,
    ) -> Float64[np.ndarray, "7"]:
        """Terms that solve the normal equations within bounds; a term at a bound is held there.

        Args:
            terms: Values at which the sums were made.
            longest_us: Largest refractory time.
            times: Multiplicity of each tile; one if not given.
        """
        times = np.ones(len(self.matrix), np.int64) if times is None else times
        matrix, right = np.tensordot(times, self.matrix, 1), times @ self.right
        low = np.array([LOWEST, LOWEST, -1, -1, -1, EARLIEST_MS, 0.0])
        high = np.array([HIGHEST, HIGHEST, 1, 1, 1, LATEST_MS, longest_us])
        free, fixed = np.ones(TERMS, bool), terms.copy()
        for _ in range(TERMS):
            unit = np.sqrt(np.abs(np.diag(matrix)))[free] + 1e-12
            rest = right[free] - matrix[free][:, ~free] @ (fixed - terms)[~free]
            scaled = matrix[free][:, free] / unit[:, None] / unit
            fixed[free] = terms[free] + np.linalg.lstsq(scaled, rest / unit, rcond=1e-9)[0] / unit
            beyond = free & ((fixed < low) | (fixed > high))
            fixed = np.clip(fixed, low, high)
            if not beyond.any():
                break
            free &= ~beyond
        return fixed

    def spread(
        self, terms: Float64[np.ndarray, "7"], longest_us: float, draw: np.random.Generator
    ) -> Float64[np.ndarray, "7"]:
        """Robust standard deviation of the terms over bootstrap samples of tiles."""
        count = len(self.matrix)
        found = []
        for _ in range(RESAMPLES):
            times = draw.multinomial(count, np.full(count, 1 / count))
            found.append(self.step(terms, longest_us, times))
        return 1.4826 * np.median(np.abs(np.array(found) - np.median(found, 0)), 0)


def longest_dead_us(index: EventIndex) -> float:
    """The longest refractory time that the intervals between events allow."""
    apart = np.diff(index.t_us)
    borders = index.offset[1:-1]
    apart[borders[(borders > 0) & (borders < len(index))] - 1] = np.iinfo(np.int64).max
    same = apart[(index.p[1:] == index.p[:-1]) & (apart > 0)]
    return DEAD_SHARE * float(np.quantile(same, SHORTEST_QUANTILE)) if len(same) else 0.0


def with_events_around(equations: Equations) -> Equations:
    """Equations whose neighbours have events; their own events would select noisy pixels."""
    count = equations.by_events(START)[:, 1:3].sum(-1, keepdims=True)
    return equations.subset(equations.neighbour_mean(count)[:, 0] > 0)


def _slopes(
    equations: Equations, terms: Float64[np.ndarray, "7"]
) -> tuple[Float64[np.ndarray, "e 7"], Float64[np.ndarray, "e"]]:
    """Derivative of each equation by each term, and the activity of its neighbours."""
    base = equations.by_events(terms)  # [e, 5]
    slopes = np.ones((len(base), TERMS))
    for term, step in (
        (NEGATIVE, THRESHOLD_STEP),
        (POSITIVE, THRESHOLD_STEP),
        (DEAD_US, DEAD_STEP_US),
    ):
        more = terms + step * np.eye(TERMS)[term]
        slopes[:, term] = (equations.by_events(more)[:, 0] - base[:, 0]) / step
    later = LATE_STEP_MS * np.eye(TERMS)[LATE_MS]
    apart = equations.by_events(terms + later)[:, 0] - equations.by_events(terms - later)[:, 0]
    slopes[:, LATE_MS] = apart / (2 * LATE_STEP_MS)
    slopes[:, LAST], slopes[:, NEXT] = base[:, 3], base[:, 4]
    around = equations.neighbour_mean(base[:, 1:3] * terms[[NEGATIVE, POSITIVE]])
    return slopes, np.square(around).sum(-1)


def _activity(
    events: Float64[np.ndarray, "e 5"], terms: Float64[np.ndarray, "7"]
) -> Float64[np.ndarray, "e"]:
    """Sum of the squared changes to darker and to brighter.

    The variance due to differing thresholds of pixels is proportional to it.
    """
    return np.square(events[:, 1:3] * terms[[NEGATIVE, POSITIVE]]).sum(-1)


def _spread(
    residual: Float64[np.ndarray, "e"], activity: Float64[np.ndarray, "e"]
) -> tuple[float, float]:
    """Variance of residuals at zero activity, and its slope by activity."""
    edges = np.unique(np.quantile(activity, np.linspace(0, 1, LEVELS + 1)))
    level = np.clip(np.searchsorted(edges, activity, side="right") - 1, 0, max(len(edges) - 2, 0))
    levels = np.unique(level)
    mean_activity = np.array([activity[level == one].mean() for one in levels])
    variance = np.array([np.median(np.abs(residual[level == one])) for one in levels])
    variance = np.maximum(np.square(1.4826 * variance), 1e-9)
    design = np.column_stack([np.ones_like(mean_activity), mean_activity]) / variance[:, None]
    noise, growth = np.linalg.lstsq(design, np.ones_like(mean_activity), rcond=1e-12)[0]
    if growth < 0 or noise < variance.min() / 4:
        noise = variance.min() / 4 if growth > 0 else variance.mean()
        growth = max(float(growth), 0.0)
    return max(float(noise), 1e-9), float(growth)


def _neighbours(
    values: Float64[np.ndarray, "m"], pixel: Int64[np.ndarray, "m"], width: int, height: int
) -> Float64[np.ndarray, "m"]:
    """Sum over the eight neighbours of each pixel."""
    total = np.bincount(pixel, values, minlength=width * height).reshape(height, width)
    border = cv2.BORDER_CONSTANT
    box = cv2.boxFilter(total, cv2.CV_64F, (3, 3), normalize=False, borderType=border)
    return (box - total).ravel()[pixel]
