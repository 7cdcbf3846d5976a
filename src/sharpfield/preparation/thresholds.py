"""The contrast thresholds of a capture: given, known from its source, or found from its frames."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import Tone, luma, tone_of
from sharpfield.events.double_integral import latent
from sharpfield.events.motion import EventMotion
from sharpfield.events.threshold import FixedThresholds
from sharpfield.events.threshold_search import (
    best_threshold,
    best_thresholds,
    disagreement,
    distance_from_usual,
    edge_density,
)

PAIRS = 4
"""Pairs of neighbouring frames looked at, spread over the capture."""

DARK, BRIGHT = 0.01, 0.9
"""Linear light between which a pixel's value can be trusted."""

Judge = Literal["given", "known", "disagreement", "edge density"]


@dataclass(frozen=True)
class Found:
    """Thresholds, and how they were come by."""

    thresholds: FixedThresholds
    judge: Judge
    cost: float | None = None
    """What the judge says of them; see `formation.edi_threshold`."""


def known_thresholds(capture: Capture) -> FixedThresholds | None:
    """What the source of the capture says of both signs; None if it is silent."""
    known = capture.known.thresholds
    return None if known is None else FixedThresholds(known.negative, known.positive)


def find_thresholds(capture: Capture, motion: EventMotion) -> Found:
    """Thresholds that explain the blurred frames best.

    Neighbouring frames of one track decide by disagreement, for each sign by itself; a capture of
    a single blurred frame leaves only the density of edges in the deblurred image.

    Raises:
        CaptureError: There are no frames, or no events.
    """
    blurred = np.flatnonzero(~capture.needed_frames.exposure.instant)
    pairs = neighbours(capture, blurred)
    if len(pairs):
        chosen = evenly_spread(pairs, PAIRS)
        judges = [_PairJudge.of(capture, motion, pair) for pair in chosen]
        found = best_thresholds(
            lambda tried: float(np.mean([judge.cost(tried) for judge in judges]))
        )
        cost = float(np.mean([judge.cost(found) for judge in judges]))
        return Found(found, "disagreement", cost)
    single = [_SingleJudge.of(capture, motion, int(frame)) for frame in blurred[:PAIRS]]
    found = best_threshold(lambda tried: float(np.mean([judge.cost(tried) for judge in single])))
    return Found(found, "edge density", float(np.mean([judge.cost(found) for judge in single])))


def linear_light(capture: Capture, frame: int, tone: Tone) -> Float[Tensor, "h w c"]:
    """A frame in linear light."""
    frames = capture.needed_frames
    stored = torch.from_numpy(np.asarray(frames.images[frame], np.float32)) / frames.white
    return tone.decode(stored)


def neighbours(capture: Capture, frames: Int64[np.ndarray, "a"]) -> Int64[np.ndarray, "m 2"]:
    """Consecutive frames of one track, in order of time."""
    held = capture.needed_frames
    order = frames[np.lexsort((held.exposure.open_us[frames], held.track[frames]))]
    pairs = np.stack([order[:-1], order[1:]], -1).reshape(-1, 2)
    return pairs[held.track[pairs[:, 0]] == held.track[pairs[:, 1]]]


@dataclass(frozen=True)
class _PairJudge:
    motion: EventMotion
    light: Float[Tensor, "n h w c"]
    windows_us: list[tuple[int, int]]
    middles_us: list[int]

    @classmethod
    def of(
        cls, capture: Capture, motion: EventMotion, pair: Int64[np.ndarray, "2"]
    ) -> "_PairJudge":
        tone = tone_of(capture.needed_frames.encoding)
        light = torch.stack([linear_light(capture, int(frame), tone) for frame in pair])
        if motion.channel is None:
            light = luma(light)[..., None]
        middles = [int(capture.needed_frames.exposure.middle_us[frame]) for frame in pair]
        return cls(
            motion,
            light,
            [capture.needed_frames.exposure.window(int(frame)) for frame in pair],
            middles,
        )

    def cost(self, thresholds: FixedThresholds) -> float:
        paths = [
            self.motion.path(window, np.array([middle]), thresholds)
            for window, middle in zip(self.windows_us, self.middles_us, strict=True)
        ]
        gap = self.motion.between(self.middles_us[0], self.middles_us[1], thresholds)
        usable = (self.light > DARK) & (self.light < BRIGHT)
        return disagreement(self.light, paths, gap[None], usable)


@dataclass(frozen=True)
class _SingleJudge:
    motion: EventMotion
    light: Float[Tensor, "h w c"]
    window_us: tuple[int, int]
    tone: Tone

    @classmethod
    def of(cls, capture: Capture, motion: EventMotion, frame: int) -> "_SingleJudge":
        tone = tone_of(capture.needed_frames.encoding)
        window = capture.needed_frames.exposure.window(frame)
        return cls(motion, linear_light(capture, frame, tone), window, tone)

    def cost(self, thresholds: FixedThresholds) -> float:
        path = self.motion.path(self.window_us, np.array([sum(self.window_us) // 2]), thresholds)
        sharp = self.tone.encode(latent(self.light, path, 0).clamp(0, 1))
        where = _grown(path.log_mean != 0)
        return edge_density(luma(sharp)[..., None], where) + distance_from_usual(thresholds)


def _grown(moved: Bool[Tensor, "h w c"]) -> Bool[Tensor, "h w 1"]:
    """Pixels within two of one that moved, in any colour."""
    any_colour = moved.any(-1).float()[None, None]
    return nn.functional.max_pool2d(any_colour, 5, 1, 2)[0, 0, ..., None] > 0
