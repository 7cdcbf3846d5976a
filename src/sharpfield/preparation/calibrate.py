"""Contrast thresholds of an event camera, measured from any capture that has frames as well.

Every pixel of every pair of exposures is one equation (see `exposure_pairs`): its left side comes
from the frames, its right side grows with both thresholds. Counts of events are exact and what they
leave open is the light since, so frames are regressed on events and not the other way round. The
equations also have terms for the gain of a frame and for which way the light went on, and the
pixels' dead time is what leaves the smallest residuals; what cannot be told of it adds to the
uncertainty.

Pixels that contradict the fit lose weight (Tukey's biweight), so that hot pixels, saturated ones
and moving shadows do not decide. The rest of the
uncertainty is a bootstrap over tiles of pixels and pairs.

Sources: Wang et al., "Event camera calibration of per-pixel biased contrast threshold" (ACRA 2019)
for regressing log intensity on counts; Beaton and Tukey (1974) for the weights.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.seed import numpy_generator
from sharpfield.formation.edi_threshold import HIGHEST, LOWEST, USUAL
from sharpfield.ops.event_index import EventIndex, build
from sharpfield.preparation.event_health import counts, odd_pixels
from sharpfield.preparation.exposure_pairs import (
    ExposurePair,
    at_sites,
    exposure_pairs,
    told,
    weights,
)

START = np.array([USUAL, USUAL, 0.0, 0.0, 0.0])
ROUNDS, STEP = 3, 0.02
"""Gauss-Newton steps, and the change of a threshold that measures a slope."""

TUKEY = 4.7
"""Residuals beyond so many standard deviations count for nothing."""

TILE, DRAWS = 16, 200
"""Side of a tile in px, and how often tiles are drawn anew for the uncertainty."""

LEAST_EQUATIONS, MOST_EQUATIONS = 200, 60_000
LEAST_CHANGE = 0.02
"""Mean absolute change of log light below which nothing moved."""

DEAD_US, SHORTEST = (50.0, 100.0, 200.0, 400.0, 800.0), 0.005
"""Dead times tried, as long as only this share of intervals between events is shorter."""

PLAUSIBLE = 1.01
"""Dead times whose residuals are this much larger than the smallest cannot be ruled out."""

ENOUGH = 4.0
"""Events of a pixel must say so many standard deviations of change for it to be judged."""

SURE = 5.0
OFF_BY = 0.35
"""A deviating pixel is off by so many standard deviations, and by this share of the threshold."""


@dataclass(frozen=True)
class CalibrateOptions:
    """How thresholds are measured."""

    pairs: int = 12
    """Pairs of exposures looked at, spread over the capture."""
    seed: int = 0
    """Of the bootstrap."""


@dataclass(frozen=True)
class Calibration:
    """Thresholds with their uncertainty, and pixels that differ."""

    negative: float
    positive: float
    negative_sigma: float
    """One standard deviation."""
    positive_sigma: float
    dead_us: float
    """Dead time of a pixel that explains the frames best, of those tried."""
    explained: float
    """Correlation of what the events say with what the frames saw."""
    residual: float
    """Robust standard deviation of the difference, natural log."""
    drift: float
    """Change of log light per pair that no event accounts for: gain of the frames, or leak."""
    equations: int
    pairs: int
    ratio: Float32[np.ndarray, "h w"]
    """Threshold of each pixel over the common one; NaN where too little happened to tell."""
    deviating: Bool[np.ndarray, "h w"]
    """Pixels that surely differ by more than `OFF_BY`."""
    dead: Bool[np.ndarray, "h w"]
    """Without any event although the frames changed."""
    hot: Bool[np.ndarray, "h w"]
    """With many more events than the pixels around them."""


def calibrate(capture: Capture, options: CalibrateOptions) -> Calibration:
    """Measure thresholds.

    Args:
        capture: With frames and events of the same pixels; poses are not looked at.
        options: How much to look at.

    Raises:
        CaptureError: Frames or events are missing, or nothing moved.
    """
    index = build(capture.needed_events)
    pairs = exposure_pairs(capture, most=options.pairs)
    equations = _Equations.of(capture, index, pairs, MOST_EQUATIONS)
    if len(equations.seen) < LEAST_EQUATIONS or np.abs(equations.seen).mean() < LEAST_CHANGE:
        raise CaptureError(
            "too little changed between frames to measure thresholds",
            where=capture.name,
            got=f"{len(equations.seen)} usable pixels with events",
            do="record something that moves, neither too dark nor saturated",
        )
    tried = [_Fit.of(equations, dead_us, START, rounds=ROUNDS) for dead_us in _dead_times(index)]
    best = min(tried, key=lambda one: one.cost)
    likely = np.stack([one.terms[:2] for one in tried if one.cost < PLAUSIBLE * best.cost])
    fit = _Fit.of(equations, best.dead_us, best.terms, rounds=ROUNDS)
    drawn = fit.spread(numpy_generator(options.seed, 0, "calibrate"))[:2]
    spread = np.hypot(drawn, likely.std(0))
    every = _Equations.of(capture, index, pairs, None)
    return Calibration(
        negative=float(fit.terms[0]),
        positive=float(fit.terms[1]),
        negative_sigma=float(spread[0]),
        positive_sigma=float(spread[1]),
        dead_us=fit.dead_us,
        explained=fit.explained,
        residual=fit.scale,
        drift=float(fit.terms[2]),
        equations=len(equations.seen),
        pairs=len(pairs),
        **_pixels(capture, every, _Fit.of(every, fit.dead_us, fit.terms, rounds=0)),
    )


@dataclass(frozen=True)
class _Equations:
    """One for each usable site with events of each pair; some of them, if there are many."""

    index: EventIndex
    pairs: list[ExposurePair]
    sites: list[Int64[np.ndarray, "_"]]
    """That have an equation, of each pair."""
    seen: Float64[np.ndarray, "e"]
    """What the frames say."""
    tile: Int64[np.ndarray, "e"]

    @classmethod
    def of(
        cls, capture: Capture, index: EventIndex, pairs: list[ExposurePair], most: int | None
    ) -> "_Equations":
        even, draw = np.ones(len(index)), numpy_generator(0, 0, "equations")
        sites, seen, tile = [], [], []
        across = -(-capture.camera.width // TILE)
        tiles = across * -(-capture.camera.height // TILE)
        for number, pair in enumerate(pairs):
            own = index.sites_of(int(capture.needed_frames.track[pair.frames[0]]))
            own = own[at_sites(pair.usable, capture, index, own)]
            own = own[told(index, even, pair, own, (1.0, 1.0)).count.sum(-1) > 0]
            if most is not None and len(own) > most // len(pairs):
                own = np.sort(draw.choice(own, most // len(pairs), replace=False))
            x, y = (index.site_xy[own] // TILE).astype(np.int64).T
            sites.append(own)
            seen.append(at_sites(pair.change, capture, index, own))
            tile.append(number * tiles + np.clip(y * across + x, 0, tiles - 1))
        return cls(index, pairs, sites, np.concatenate(seen), np.concatenate(tile))

    def told(
        self, weight: Float64[np.ndarray, "n"], thresholds: tuple[float, float]
    ) -> tuple[Float64[np.ndarray, "e"], Float64[np.ndarray, "e 2"]]:
        """What the events say, and the surroundings."""
        expected, around = [], []
        for pair, sites in zip(self.pairs, self.sites, strict=True):
            one = told(self.index, weight, pair, sites, thresholds)
            expected.append(one.expected)
            around.append(np.stack([one.last, one.next], -1))
        return np.concatenate(expected), np.concatenate(around)


@dataclass(frozen=True)
class _Fit:
    """Thresholds with the smallest residuals, for one dead time."""

    dead_us: float
    terms: Float64[np.ndarray, "5"]
    """Thresholds to darker and brighter, drift, and how far light goes on: last, next event."""
    slopes: Float64[np.ndarray, "e 5"]
    """What each equation gains per unit of each term."""
    expected: Float64[np.ndarray, "e"]
    left: Float64[np.ndarray, "e"]
    weight: Float64[np.ndarray, "e"]
    scale: float
    explained: float
    tile: Int64[np.ndarray, "e"]

    @classmethod
    def of(
        cls,
        equations: _Equations,
        dead_us: float,
        terms: Float64[np.ndarray, "5"],
        *,
        rounds: int,
    ) -> "_Fit":
        weight = weights(equations.index, dead_us)
        for _ in range(rounds):
            terms, _ = cls._round(equations, weight, dead_us, terms)
        return cls._round(equations, weight, dead_us, terms)[1]

    @classmethod
    def _round(
        cls,
        equations: _Equations,
        weight: Float64[np.ndarray, "n"],
        dead_us: float,
        terms: Float64[np.ndarray, "5"],
    ) -> "tuple[Float64[np.ndarray, '5'], _Fit]":
        """Terms after one Gauss-Newton step, and the fit with those before."""
        low, high = terms[:2].tolist()
        base, around = equations.told(weight, (low, high))
        darker = (equations.told(weight, (low + STEP, high))[0] - base) / STEP
        brighter = (equations.told(weight, (low, high + STEP))[0] - base) / STEP
        slopes = np.stack([darker, brighter, np.ones_like(base), *around.T], -1)
        expected = base + slopes[:, 2:] @ terms[2:]
        left = equations.seen - expected
        middle = float(np.median(left))
        scale = max(1.4826 * float(np.median(np.abs(left - middle))), 1e-6)
        far = np.clip(np.abs(left - middle) / (TUKEY * scale), 0, 1)
        trust = (1 - far**2) ** 2
        fit = cls(
            *(dead_us, terms, slopes, expected, left, trust, scale),
            float(np.corrcoef(equations.seen, expected)[0, 1]),
            equations.tile,
        )
        stepped = (
            terms
            + np.linalg.lstsq(
                (trust[:, None] * slopes).T @ slopes, slopes.T @ (trust * left), rcond=1e-12
            )[0]
        )
        stepped[:2] = np.clip(stepped[:2], LOWEST, HIGHEST)
        return stepped, fit

    @property
    def cost(self) -> float:
        """Mean absolute residual."""
        return float(np.abs(self.left).mean())

    def spread(self, draw: np.random.Generator) -> Float64[np.ndarray, "5"]:
        """Standard deviation of the terms over draws of tiles."""
        count = int(self.tile.max()) + 1
        product, right = np.zeros((count, 5, 5)), np.zeros((count, 5))
        weighted = self.weight[:, None] * self.slopes
        np.add.at(product, self.tile, weighted[:, :, None] * self.slopes[:, None])
        np.add.at(right, self.tile, weighted * self.left[:, None])
        kept = np.flatnonzero(product[:, 2, 2] > 0)
        found = []
        for _ in range(DRAWS):
            times = draw.multinomial(len(kept), np.full(len(kept), 1 / len(kept)))
            matrix = np.tensordot(times, product[kept], 1)
            found.append(np.linalg.lstsq(matrix, times @ right[kept], rcond=1e-12)[0])
        return 1.4826 * np.median(np.abs(np.array(found) - np.median(found, 0)), 0)


def _dead_times(index: EventIndex) -> list[float]:
    """Dead times that could be: none, and those shorter than all but few intervals."""
    apart = np.diff(index.t_us)
    borders = index.offset[1:-1]
    apart[borders[(borders > 0) & (borders < len(index))] - 1] = np.iinfo(np.int64).max
    same = apart[(index.p[1:] == index.p[:-1]) & (apart > 0)]
    shortest = float(np.quantile(same, SHORTEST)) if len(same) else 0.0
    return [0.0, *(dead for dead in DEAD_US if dead <= shortest)]


def _pixels(
    capture: Capture, equations: _Equations, fit: _Fit
) -> dict[str, Shaped[np.ndarray, "h w"]]:
    """Maps of what single pixels do, by the equations of each."""
    width, height = capture.camera.size
    xy = np.concatenate([equations.index.site_xy[sites] for sites in equations.sites])
    x, y = np.rint(xy).astype(np.int64).T
    at = np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)

    def total(values: Float64[np.ndarray, "e"]) -> Float64[np.ndarray, "h w"]:
        return np.bincount(at, values, minlength=width * height).reshape(height, width)

    events_say = total(fit.expected**2)
    enough = events_say > (ENOUGH * fit.scale) ** 2
    ratio = total(equations.seen * fit.expected) / np.where(enough, events_say, 1)
    sigma = fit.scale / np.sqrt(np.where(enough, events_say, 1))
    off = (np.abs(ratio - 1) > SURE * sigma) & (np.abs(ratio - 1) > OFF_BY)
    dead, hot = odd_pixels(counts(capture.needed_events))
    return {
        "ratio": np.where(enough, ratio, np.nan).astype(np.float32),
        "deviating": enough & off & ~hot,
        "dead": dead,
        "hot": hot,
    }
