"""Sharp pictures from the event double integral, as targets for single rays."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Pixels
from sharpfield.formation.tone import tone_of
from sharpfield.ops.event_image import window_image
from sharpfield.ops.event_index import EventIndex

FINENESS = 4
"""Slices on either side of each instant, in the finer integral."""


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
    """Released code integrates stored values; light adds up in linear."""
    slices: int = 8
    """Slices of an exposure in the published integral at its middle."""


class MiddlePrior(nn.Module):
    """The published target: a sharp picture of each frame at the middle of its exposure."""

    def __init__(
        self,
        options: PriorOptions,
        capture: Capture,
        index: EventIndex,
        threshold: tuple[float, float],
    ) -> None:
        super().__init__()
        edges = options.slices
        log = log_changes(capture, index, threshold, slices=edges)  # [n, slices + 1, h, w]
        mean = log.exp().mean(1)
        self.register_buffer("ratio", (log[:, edges // 2].exp() / mean), persistent=False)
        self.tone = tone_of(capture.needed_frames.encoding)
        self.linear = options.domain == "linear"

    def target(self, seen: Pixels) -> Float[Tensor, "b c"]:
        """Stored value a sharp pixel would have; not clipped in the display domain."""
        ratio = _at(self.ratio, seen)[:, None]
        if not self.linear:
            return seen.value * ratio
        return self.tone.encode((self.tone.decode(seen.value) * ratio).clamp(0, 1))


class InstantsPrior(nn.Module):
    """Sharp light at several instants of each exposure, in linear light."""

    def __init__(
        self, capture: Capture, index: EventIndex, threshold: tuple[float, float], *, instants: int
    ) -> None:
        super().__init__()
        log = log_changes(capture, index, threshold, slices=2 * FINENESS * instants)
        mean = ((log[:, 1:] + log[:, :-1]) / 2).exp().mean(1)
        middles = log[:, FINENESS :: 2 * FINENESS]
        ratio = (middles.exp() / mean[:, None]).half()
        self.register_buffer("ratio", ratio, persistent=False)  # [n, k, h, w]
        self.tone = tone_of(capture.needed_frames.encoding)

    def target(self, seen: Pixels) -> Float[Tensor, "b k c"]:
        """Stored values a sharp pixel would have at each instant."""
        x, y = seen.xy.long().unbind(-1)
        ratio = self.ratio[seen.frame, :, y, x].float()
        light = self.tone.decode(seen.value)[:, None] * ratio[..., None]
        return self.tone.encode(light.clamp(0, 1))


def log_changes(
    capture: Capture, index: EventIndex, threshold: tuple[float, float], *, slices: int
) -> Float[Tensor, "n t h w"]:
    """Change of log light since each shutter opened, at the edges of equal slices; t = slices + 1.

    Frames that are not learned from are left at zero.
    """
    frames = capture.needed_frames
    darker, brighter = threshold
    log = np.zeros((len(frames), slices + 1, frames.height, frames.width), np.float32)
    for i in capture.split.train:
        opened, closed = frames.exposure.open_us[i], frames.exposure.close_us[i]
        edges = np.linspace(opened, closed, slices + 1).round().astype(np.int64)
        for j, (start, end) in enumerate(zip(edges, edges[1:], strict=False)):
            counts = window_image(
                index, int(start), int(end), width=frames.width, height=frames.height
            )
            log[i, j + 1] = log[i, j] + brighter * counts[..., 1] - darker * counts[..., 0]
    return torch.from_numpy(log)


def _at(images: Float[Tensor, "n h w"], seen: Pixels) -> Float[Tensor, "b"]:
    x, y = seen.xy.long().unbind(-1)
    return images[seen.frame, y, x]
