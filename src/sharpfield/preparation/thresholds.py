"""Contrast thresholds of a capture: given, stated by its source, or found from blurred frames."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import Tone, luma, tone_of
from sharpfield.events.counts import EventMotion
from sharpfield.events.double_integral import latent
from sharpfield.events.threshold import FixedThresholds
from sharpfield.events.threshold_search import (
    best_threshold,
    best_thresholds,
    disagreement,
    distance_from_usual,
    edge_density,
)

PAIRS = 4
"""Number of pairs of neighbouring frames, spread over the capture."""

DARK, BRIGHT = 0.01, 0.9
"""Range of linear light in which pixel values are reliable."""

ThresholdSource = Literal["given", "known", "disagreement", "edge density"]
"""Given by an option, stated by the capture, or found by minimising one of two costs."""


@dataclass(frozen=True)
class FoundThresholds:
    """Thresholds, and where they come from."""

    thresholds: FixedThresholds
    source: ThresholdSource
    cost: float | None = None
    """Value of the minimised cost; see `events.threshold_search`."""


def known_thresholds(capture: Capture) -> FixedThresholds | None:
    """Thresholds that the capture states; None if it states none."""
    known = capture.known.thresholds
    return None if known is None else FixedThresholds(known.negative, known.positive)


def find_thresholds(capture: Capture, motion: EventMotion) -> FoundThresholds:
    """Thresholds that explain the blurred frames best.

    With neighbouring frames of one track, their disagreement after deblurring is minimised, over
    both polarities; with a single blurred frame, the edge density of the deblurred image.

    Raises:
        CaptureError: There are no frames, or no events.
    """
    blurred = np.flatnonzero(~capture.needed_frames.exposure.instant)
    pairs = consecutive_pairs(capture, blurred)
    if len(pairs):
        chosen = evenly_spread(pairs, PAIRS)
        costs = [_PairCost.of(capture, motion, pair) for pair in chosen]
        found = best_thresholds(lambda tried: float(np.mean([one(tried) for one in costs])))
        cost = float(np.mean([one(found) for one in costs]))
        return FoundThresholds(found, "disagreement", cost)
    single = [_SingleCost.of(capture, motion, int(frame)) for frame in blurred[:PAIRS]]
    found = best_threshold(lambda tried: float(np.mean([one(tried) for one in single])))
    return FoundThresholds(found, "edge density", float(np.mean([one(found) for one in single])))


def linear_light(capture: Capture, frame: int, tone: Tone) -> Float[Tensor, "h w c"]:
    """A frame in linear light."""
    frames = capture.needed_frames
    stored = torch.from_numpy(np.asarray(frames.images[frame], np.float32)) / frames.white
    return tone.decode(stored)


def consecutive_pairs(capture: Capture, frames: Int64[np.ndarray, "a"]) -> Int64[np.ndarray, "m 2"]:
    """Pairs of consecutive frames of one track."""
    all_frames = capture.needed_frames
    order = frames[np.lexsort((all_frames.exposure.open_us[frames], all_frames.track[frames]))]
    pairs = np.stack([order[:-1], order[1:]], -1).reshape(-1, 2)
    return pairs[all_frames.track[pairs[:, 0]] == all_frames.track[pairs[:, 1]]]


@dataclass(frozen=True)
class _PairCost:
    """Disagreement of two neighbouring frames after deblurring with some thresholds."""

    motion: EventMotion
    light: Float[Tensor, "n h w c"]
    windows_us: list[tuple[int, int]]
    middles_us: list[int]

    @classmethod
    def of(cls, capture: Capture, motion: EventMotion, pair: Int64[np.ndarray, "2"]) -> "_PairCost":
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

    def __call__(self, thresholds: FixedThresholds) -> float:
        paths = [
            self.motion.path(window, np.array([middle]), thresholds)
            for window, middle in zip(self.windows_us, self.middles_us, strict=True)
        ]
        gap = self.motion.between(self.middles_us[0], self.middles_us[1], thresholds)
        usable = (self.light > DARK) & (self.light < BRIGHT)
        return disagreement(self.light, paths, gap[None], usable)


@dataclass(frozen=True)
class _SingleCost:
    """Edge density of one frame after deblurring with some thresholds."""

    motion: EventMotion
    light: Float[Tensor, "h w c"]
    window_us: tuple[int, int]
    tone: Tone

    @classmethod
    def of(cls, capture: Capture, motion: EventMotion, frame: int) -> "_SingleCost":
        tone = tone_of(capture.needed_frames.encoding)
        window = capture.needed_frames.exposure.window(frame)
        return cls(motion, linear_light(capture, frame, tone), window, tone)

    def __call__(self, thresholds: FixedThresholds) -> float:
        path = self.motion.path(self.window_us, np.array([sum(self.window_us) // 2]), thresholds)
        sharp = self.tone.encode(latent(self.light, path, 0).clamp(0, 1))
        where = _dilated(path.log_mean != 0)
        return edge_density(luma(sharp)[..., None], where) + distance_from_usual(thresholds)


def _dilated(moved: Bool[Tensor, "h w c"]) -> Bool[Tensor, "h w 1"]:
    """Pixels within two of one with events in its exposure, in any colour."""
    any_colour = moved.any(-1).float()[None, None]
    return nn.functional.max_pool2d(any_colour, 5, 1, 2)[0, 0, ..., None] > 0
