"""Thresholds and the other terms of a sensor, from equations between frames and events.

Every pixel of every pair of exposures is one equation (see `exposure_pairs`): its left side comes
from the frames, its right side grows with the *terms*: both thresholds, the drift per pair, how far
light goes on after the last event and before the next one, how late events come, and for how long
a pixel is dead after one.

Both sides are wrong by a little. Events have noise, pixels differ in their thresholds, and counts
leave open what a part of a threshold was. A plain regression takes such errors for a weaker link
and finds thresholds that are too low. The errors of neighbouring pixels have nothing to do with
each other, though, and the light that they see has: so each *slope* of an equation is correlated
with that of the pixels around it, its *instrument*, and only what they share counts.

A busy pixel is off by more, because its own threshold differs from the common one: the spread of
residuals is told for each number of events. Beyond a few such deviations an equation has no weight
(Tukey's biweight), so that hot pixels, saturated ones and moving shadows do not decide.

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
from sharpfield.preparation.calibrate.exposure_pairs import ExposurePair, at_sites, told, weights

NEGATIVE, POSITIVE, DRIFT, LAST, NEXT, LATE_MS, DEAD_US = range(7)
"""Terms by position."""
TERMS = 7
START = np.array([USUAL, USUAL, 0.0, 0.0, 0.0, 0.0, 0.0])
THRESHOLD_STEP, LATE_STEP_MS, DEAD_STEP_US = 0.02, 1.0, 40.0
"""Changes of a term that measure its slope."""

EARLIEST_MS, LATEST_MS = -5.0, 20.0
"""Events can be late, by the bandwidth of the pixels, and little earlier than the frames say."""
SHORTEST, DEAD_SHARE = 0.002, 0.8
"""A dead time is at most this share of all but the shortest intervals between events, that many."""

TUKEY = 4.7
"""Residuals beyond so many standard deviations count for nothing."""
TILE = 16
"""Side of a tile in px: equations are chosen, and drawn anew, by whole tiles."""
LEVELS = 8
"""Numbers of events that the spread of residuals is told for."""
DRAWS = 200


@dataclass(frozen=True)
class Equations:
    """One for each usable site of each pair; those of some tiles, if there are many."""

    index: EventIndex
    pairs: list[ExposurePair]
    sites: list[Int64[np.ndarray, "_"]]
    """That have an equation, of each pair."""
    place: list[Int64[np.ndarray, "_"]]
    """Row-major pixel of each."""
    size: tuple[int, int]
    """Width and height in px."""
    seen: Float64[np.ndarray, "e"]
    """What the frames say."""
    tile: Int64[np.ndarray, "e"]

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
        """Set them up.

        Args:
            capture: With frames and events.
            index: All events by site.
            pairs: Of exposures.
            without: Pixels to leave out.
            most: How many are enough; all if not given.
        """
        width, height = capture.camera.size
        across, down = -(-width // TILE), -(-height // TILE)
        share = 1.0 if most is None else most / (len(pairs) * width * height)
        draw = numpy_generator(0, 0, "equations")
        kept, places, seen, tiles = [], [], [], []
        for number, pair in enumerate(pairs):
            own = index.sites_of(int(capture.needed_frames.track[pair.frames[0]]))
            x, y = np.rint(index.site_xy[own]).astype(np.int64).T
            x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
            tile = y // TILE * across + x // TILE
            taken = draw.permutation(across * down) < max(share * across * down, 1)
            good = at_sites(pair.usable, capture, index, own) & taken[tile] & ~without[y, x]
            kept.append(own[good])
            places.append((y * width + x)[good])
            seen.append(at_sites(pair.change, capture, index, own[good]))
            tiles.append(number * across * down + tile[good])
        return cls(
            *(index, pairs, kept, places, (width, height)),
            np.concatenate(seen),
            np.concatenate(tiles),
        )

    def picked(self, good: Bool[np.ndarray, "e"]) -> "Equations":
        """Some of them."""
        parts = np.split(good, np.cumsum([len(sites) for sites in self.sites])[:-1])
        return replace(
            self,
            sites=[one[part] for one, part in zip(self.sites, parts, strict=True)],
            place=[one[part] for one, part in zip(self.place, parts, strict=True)],
            seen=self.seen[good],
            tile=self.tile[good],
        )

    def told(self, terms: Float64[np.ndarray, "7"]) -> Float64[np.ndarray, "e 5"]:
        """What events say: their change, counts to darker and to brighter, last and next sign."""
        weight = weights(self.index, float(terms[DEAD_US]))
        thresholds = float(terms[NEGATIVE]), float(terms[POSITIVE])
        late_us = round(1000 * float(terms[LATE_MS]))
        found = []
        for pair, sites in zip(self.pairs, self.sites, strict=True):
            one = told(self.index, weight, pair.later(late_us), sites, thresholds)
            found.append(np.column_stack([one.expected, one.count, one.last, one.next]))
        return np.concatenate(found)

    def around(self, values: Float64[np.ndarray, "e c"]) -> Float64[np.ndarray, "e c"]:
        """Means over the eight pixels around each, of those that have an equation."""
        width, height = self.size
        found, first = np.empty_like(values), 0
        for place in self.place:
            part = slice(first, first + len(place))
            first = part.stop
            many = _neighbours(np.ones(len(place)), place, width, height)
            for column in range(values.shape[1]):
                total = _neighbours(values[part, column], place, width, height)
                found[part, column] = total / np.maximum(many, 1)
        return found


@dataclass(frozen=True)
class Fit:
    """Equations at some terms."""

    terms: Float64[np.ndarray, "7"]
    expected: Float64[np.ndarray, "e"]
    left: Float64[np.ndarray, "e"]
    """What the frames say beyond what is expected."""
    spread: Float64[np.ndarray, "e"]
    """Standard deviation that an equation with as many events should have."""
    quiet: float
    """That of an equation with the fewest events."""

    @classmethod
    def at(cls, equations: Equations, terms: Float64[np.ndarray, "7"]) -> "Fit":
        """Compare both sides."""
        said = equations.told(terms)
        expected = said[:, 0] + terms[DRIFT] + said[:, 3:] @ terms[[LAST, NEXT]]
        left = equations.seen - expected
        busy = _busy(said, terms)
        noise, growth = _spread(left, busy)
        spread = np.sqrt(noise + growth * busy)
        return cls(terms, expected, left, spread, float(np.sqrt(noise)))

    @property
    def explained(self) -> float:
        """Correlation of what is seen with what is expected."""
        seen = self.left + self.expected
        if len(seen) < 2 or seen.std() == 0 or self.expected.std() == 0:
            return 0.0
        return float(np.corrcoef(seen, self.expected)[0, 1])


@dataclass(frozen=True)
class Normal:
    """The normal equations of each tile: what a step, and the uncertainty, are solved from."""

    matrix: Float64[np.ndarray, "t 7 7"]
    right: Float64[np.ndarray, "t 7"]

    @classmethod
    def of(cls, equations: Equations, fit: Fit) -> "Normal":
        """Sum up instruments times slopes, and times residuals."""
        slopes, around_busy = _slopes(equations, fit.terms)
        instruments = equations.around(slopes)
        instruments[:, DRIFT] = 1.0
        noise = fit.quiet**2
        growth = _spread(fit.left, _busy(equations.told(fit.terms), fit.terms))[1]
        trust = (1 - np.clip(np.abs(fit.left) / (TUKEY * fit.spread), 0, 1) ** 2) ** 2
        weighted = (trust / (noise + growth * around_busy))[:, None] * instruments
        order = np.argsort(equations.tile, kind="stable")
        first = np.flatnonzero(np.diff(equations.tile[order], prepend=-1))
        matrix = np.stack(
            [
                np.add.reduceat((weighted * slopes[:, [term]])[order], first)
                for term in range(TERMS)
            ],
            -1,
        )
        return cls(matrix, np.add.reduceat((weighted * fit.left[:, None])[order], first))

    def step(
        self,
        terms: Float64[np.ndarray, "7"],
        longest_us: float,
        times: Int64[np.ndarray, "t"] | None = None,
    ) -> Float64[np.ndarray, "7"]:
        """Terms that leave nothing, within what can be; a term at its limit holds the others.

        Args:
            terms: That the sums were made at.
            longest_us: That the dead time can be.
            times: How often each tile counts; once if not given.
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
        """Standard deviation of the terms over draws of tiles."""
        count = len(self.matrix)
        found = []
        for _ in range(DRAWS):
            times = draw.multinomial(count, np.full(count, 1 / count))
            found.append(self.step(terms, longest_us, times))
        return 1.4826 * np.median(np.abs(np.array(found) - np.median(found, 0)), 0)


def longest_dead_us(index: EventIndex) -> float:
    """The longest dead time that the intervals between events allow."""
    apart = np.diff(index.t_us)
    borders = index.offset[1:-1]
    apart[borders[(borders > 0) & (borders < len(index))] - 1] = np.iinfo(np.int64).max
    same = apart[(index.p[1:] == index.p[:-1]) & (apart > 0)]
    return DEAD_SHARE * float(np.quantile(same, SHORTEST)) if len(same) else 0.0


def with_events_around(equations: Equations) -> Equations:
    """Those whose neighbours have events; their own would prefer pixels that report too much."""
    count = equations.told(START)[:, 1:3].sum(-1, keepdims=True)
    return equations.picked(equations.around(count)[:, 0] > 0)


def _slopes(
    equations: Equations, terms: Float64[np.ndarray, "7"]
) -> tuple[Float64[np.ndarray, "e 7"], Float64[np.ndarray, "e"]]:
    """What each equation gains per unit of each term, and how busy the pixels around it are."""
    base = equations.told(terms)
    slopes = np.ones((len(base), TERMS))
    for term, step in (
        (NEGATIVE, THRESHOLD_STEP),
        (POSITIVE, THRESHOLD_STEP),
        (DEAD_US, DEAD_STEP_US),
    ):
        more = terms + step * np.eye(TERMS)[term]
        slopes[:, term] = (equations.told(more)[:, 0] - base[:, 0]) / step
    later = LATE_STEP_MS * np.eye(TERMS)[LATE_MS]
    apart = equations.told(terms + later)[:, 0] - equations.told(terms - later)[:, 0]
    slopes[:, LATE_MS] = apart / (2 * LATE_STEP_MS)
    slopes[:, LAST], slopes[:, NEXT] = base[:, 3], base[:, 4]
    around = equations.around(base[:, 1:3] * terms[[NEGATIVE, POSITIVE]])
    return slopes, np.square(around).sum(-1)


def _busy(
    said: Float64[np.ndarray, "e 5"], terms: Float64[np.ndarray, "7"]
) -> Float64[np.ndarray, "e"]:
    """Squares of the changes to darker and to brighter, which thresholds of a pixel scale."""
    return np.square(said[:, 1:3] * terms[[NEGATIVE, POSITIVE]]).sum(-1)


def _spread(left: Float64[np.ndarray, "e"], busy: Float64[np.ndarray, "e"]) -> tuple[float, float]:
    """Variance of residuals without events, and what it gains per unit of `busy`."""
    edges = np.unique(np.quantile(busy, np.linspace(0, 1, LEVELS + 1)))
    level = np.clip(np.searchsorted(edges, busy, side="right") - 1, 0, max(len(edges) - 2, 0))
    there = np.unique(level)
    across = np.array([busy[level == one].mean() for one in there])
    variance = np.array([np.median(np.abs(left[level == one])) for one in there])
    variance = np.maximum(np.square(1.4826 * variance), 1e-9)
    straight = np.column_stack([np.ones_like(across), across]) / variance[:, None]
    noise, growth = np.linalg.lstsq(straight, np.ones_like(across), rcond=1e-12)[0]
    if growth < 0 or noise < variance.min() / 4:
        noise = variance.min() / 4 if growth > 0 else variance.mean()
        growth = max(float(growth), 0.0)
    return max(float(noise), 1e-9), float(growth)


def _neighbours(
    values: Float64[np.ndarray, "m"], place: Int64[np.ndarray, "m"], width: int, height: int
) -> Float64[np.ndarray, "m"]:
    """Sums over the eight pixels around each."""
    total = np.bincount(place, values, minlength=width * height).reshape(height, width)
    border = cv2.BORDER_CONSTANT
    box = cv2.boxFilter(total, cv2.CV_64F, (3, 3), normalize=False, borderType=border)
    return (box - total).ravel()[place]
