"""Sharp pictures from the event double integral, as targets for single rays."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Pixels
from sharpfield.formation.edi import latent_in_light, published
from sharpfield.formation.event_motion import EventMotion
from sharpfield.formation.threshold import FixedThresholds
from sharpfield.formation.tone import tone_of


@dataclass(frozen=True)
class PriorOptions:
    """EDI pictures as targets. Defaults: Ev-DeblurNeRF's synthetic recipe."""

    weight: float = 0.01
    """Of the term at the first step; 0 leaves it out."""
    end: float = 1e-5
    """Of the term from step `until` on."""
    until: int = 10_000
    """The weight falls along half a cosine until this step."""
    domain: Literal["display", "linear"] = "display"
    """The released code integrates stored values, in eight slices; light adds up in linear."""


class MiddlePrior(nn.Module):
    """A sharp picture of each frame at the middle of its exposure, as published."""

    pictures: Tensor

    def __init__(
        self, options: PriorOptions, capture: Capture, threshold: tuple[float, float]
    ) -> None:
        super().__init__()
        frames, thresholds = capture.needed_frames, FixedThresholds(*threshold)
        tone, linear = tone_of(frames.encoding), options.domain == "linear"
        motion = EventMotion.of(capture) if linear else None
        pictures = torch.zeros(frames.images.shape)
        for i in capture.split.train:
            stored = torch.from_numpy(frames.images[i].astype(np.float32)) / frames.white
            window = frames.exposure.window(int(i))
            if motion is not None:
                middle = frames.exposure.middle_us[i : i + 1]
                path = motion.path(window, middle, thresholds)
                pictures[i] = latent_in_light(stored, path, 0, tone)
            else:
                pictures[i] = published(stored, capture.needed_events, window, thresholds)
        self.register_buffer("pictures", pictures, persistent=False)

    def target(self, seen: Pixels) -> Float[Tensor, "b c"]:
        """Stored value a sharp pixel would have; the published one is not clipped."""
        x, y = seen.xy.long().unbind(-1)
        return self.pictures[seen.frame, y, x]


class InstantsPrior(nn.Module):
    """Sharp light at several instants of each exposure, exact and in linear light."""

    ratio: Tensor

    def __init__(self, capture: Capture, threshold: tuple[float, float], *, instants: int) -> None:
        super().__init__()
        frames, thresholds = capture.needed_frames, FixedThresholds(*threshold)
        motion = EventMotion.of(capture)
        channels = 1 if motion.channel is None else frames.channels
        size = (len(frames), instants, frames.height, frames.width, channels)
        ratio = torch.ones(size, dtype=torch.half)
        part = (np.arange(instants) + 0.5) / instants
        for i in capture.split.train:
            opens, closes = window = frames.exposure.window(int(i))
            middles = opens + np.rint((closes - opens) * part).astype(np.int64)
            path = motion.path(window, middles, thresholds)
            ratio[i] = (path.change - path.log_mean).exp().half()
        self.register_buffer("ratio", ratio, persistent=False)
        self.tone = tone_of(frames.encoding)

    def target(self, seen: Pixels) -> Float[Tensor, "b k c"]:
        """Stored values a sharp pixel would have at each instant."""
        x, y = seen.xy.long().unbind(-1)
        ratio = self.ratio[seen.frame, :, y, x].float()
        light = self.tone.decode(seen.value)[:, None] * ratio
        return self.tone.encode(light.clamp(0, 1))
