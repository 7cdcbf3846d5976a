"""Latent frames: sharp images at any time of a capture, by the event double integral.

The blurred frame gives the mean light of each pixel over its exposure, the events the change
before, during and after it (`events.double_integral`). At an instant inside an exposure its own
frame is integrated to that instant; between two exposures both are, and their log light is averaged
with weights by distance in time.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.tone import tone_of
from sharpfield.events.counts import EventMotion, counts_between
from sharpfield.events.double_integral import FLOOR
from sharpfield.events.index import EventIndex
from sharpfield.events.ramps import ramp_at, ramped_log_mean
from sharpfield.events.threshold import FixedThresholds


@dataclass(frozen=True)
class SensorEstimate:
    """Estimated thresholds and clock offset of the event camera."""

    negative: float
    """Contrast threshold to darker."""
    positive: float
    """Contrast threshold to brighter."""
    late_us: int = 0
    """Its clock minus the clock of the frames."""


class LatentFrames:
    """Sharp images between the first and the last exposure of the training frames.

    Args:
        capture: With frames and events.
        motion: Of its events.
        index: Of its events, if they are of the pixels of a mono sensor; light between two events
            is then piecewise linear (`events.ramps`), otherwise a staircase.
    """

    def __init__(
        self, capture: Capture, motion: EventMotion, index: EventIndex | None = None
    ) -> None:
        self.index, self.size = index, capture.camera.size
        self.frames, self.motion = capture.needed_frames, motion
        self.tone = tone_of(self.frames.encoding)
        exposure, train = self.frames.exposure, capture.split.train
        self.order = train[np.argsort(exposure.middle_us[train])]
        self.span_us = (
            int(exposure.open_us[self.order].min()),
            int(exposure.close_us[self.order].max()),
        )
        self._log_means: dict[tuple[int, SensorEstimate], Tensor] = {}

    def at(self, time_us: int, sensor: SensorEstimate) -> Float[Tensor, "h w c"]:
        """The image at a time, as the frames would store it.

        Args:
            time_us: On the clock of the frames.
            sensor: Thresholds and clock offset of the events.
        """
        opens, closes = self.frames.exposure.open_us, self.frames.exposure.close_us
        away = np.maximum(opens[self.order] - time_us, time_us - closes[self.order]).clip(0)
        nearest = [int(i) for i in np.argsort(away, kind="stable")[:2]]
        if away[nearest[0]] == 0 or len(nearest) == 1:
            return self._encode(self._log_light(int(self.order[nearest[0]]), time_us, sensor))
        one, other = (self._log_light(int(self.order[i]), time_us, sensor) for i in nearest)
        weight = float(away[nearest[1]] / away[nearest].sum())
        return self._encode(weight * one + (1 - weight) * other)

    def _encode(self, log_light: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
        return self.tone.encode(log_light.exp().clamp(0, 1))

    def _log_light(
        self, frame: int, time_us: int, sensor: SensorEstimate
    ) -> Float[Tensor, "h w c"]:
        """Log light at a time, from one exposure and the events between its opening and then."""
        opens = int(self.frames.exposure.open_us[frame])
        first, last = (t + sensor.late_us for t in sorted((opens, time_us)))
        negative, positive = counts_between(self.motion, first, last)
        if self.index is not None:
            begin, end = (ramp_at(self.index, t, self.size) for t in (first, last))
            negative = negative + (end - begin)[..., :1]
            positive = positive + (end - begin)[..., 1:]
        change = negative * sensor.negative + positive * sensor.positive
        stored = torch.as_tensor(self.frames.images[frame].astype(np.float32)) / self.frames.white
        blurred = self.tone.decode(stored).clamp_min(FLOOR).log()
        return blurred - self._log_mean(frame, sensor) + (change if time_us >= opens else -change)

    def _log_mean(self, frame: int, sensor: SensorEstimate) -> Float[Tensor, "h w c"]:
        """Log of the mean of one exposure, relative to its opening; cached for the last one."""
        if (frame, sensor) not in self._log_means:
            for known in [key for key in self._log_means if key[0] == frame]:
                del self._log_means[known]
            opens, closes = (t + sensor.late_us for t in self.frames.exposure.window(frame))
            if self.index is not None:
                thresholds = sensor.negative, sensor.positive
                mean = ramped_log_mean(self.index, (opens, closes), thresholds, self.size)
            else:
                fixed = FixedThresholds(sensor.negative, sensor.positive)
                mean = self.motion.path((opens, closes), np.array([opens]), fixed).log_mean
            self._log_means[frame, sensor] = mean.half()
        return self._log_means[frame, sensor].float()
