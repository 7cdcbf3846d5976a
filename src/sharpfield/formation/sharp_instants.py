"""Sharp pictures at any time of a capture, by the event double integral.

Each exposure says how bright every pixel was on average, the events how its light moved before,
during and after (see `formation.edi`). Inside an exposure its own picture is carried to the
instant; between two exposures both are, and their log light is averaged by how near they are.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.formation.edi import FLOOR
from sharpfield.formation.event_counts import counts_between
from sharpfield.formation.event_motion import EventMotion
from sharpfield.formation.threshold import FixedThresholds
from sharpfield.formation.tone import tone_of


class SharpInstants:
    """Pictures between the first and the last exposure of the training frames.

    Args:
        capture: With frames and events.
        motion: Of its events.
        thresholds: To darker and to brighter.
    """

    def __init__(
        self, capture: Capture, motion: EventMotion, thresholds: tuple[float, float]
    ) -> None:
        self.frames, self.motion, self.thresholds = capture.needed_frames, motion, thresholds
        self.tone = tone_of(self.frames.encoding)
        exposure, train = self.frames.exposure, capture.split.train
        self.order: Int64[np.ndarray, n] = train[np.argsort(exposure.middle_us[train])]
        self.span_us = (
            int(exposure.open_us[self.order].min()),
            int(exposure.close_us[self.order].max()),
        )
        fixed = FixedThresholds(*thresholds)
        self.log_mean = {
            int(frame): motion.path(
                exposure.window(int(frame)), exposure.open_us[frame : frame + 1], fixed
            ).log_mean.half()
            for frame in self.order
        }

    def at(self, time_us: int, late_us: int = 0) -> Float[Tensor, "h w c"]:
        """The picture at a time, as the frames would store it.

        Args:
            time_us: By the clock of the frames.
            late_us: By how much the events' clock is late.
        """
        exposure = self.frames.exposure
        away = np.maximum(
            exposure.open_us[self.order] - time_us, time_us - exposure.close_us[self.order]
        )
        away = np.maximum(away, 0)
        nearest = np.argsort(away, kind="stable")[:2]
        if away[nearest[0]] == 0 or len(nearest) == 1:
            return self._developed(self._log_light(int(self.order[nearest[0]]), time_us, late_us))
        one, other = (self._log_light(int(self.order[i]), time_us, late_us) for i in nearest)
        share = float(away[nearest[1]] / away[nearest].sum())
        return self._developed(share * one + (1 - share) * other)

    def _developed(self, log_light: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
        return self.tone.encode(log_light.exp().clamp(0, 1))

    def _log_light(self, frame: int, time_us: int, late_us: int) -> Float[Tensor, "h w c"]:
        """What one exposure and the events from its opening to a time say."""
        opens = int(self.frames.exposure.open_us[frame])
        first, last = min(opens, time_us) + late_us, max(opens, time_us) + late_us
        negative, positive = counts_between(self.motion, first, last)
        change = negative * self.thresholds[0] + positive * self.thresholds[1]
        stored = torch.from_numpy(self.frames.images[frame].astype(np.float32)) / self.frames.white
        blurred = self.tone.decode(stored).clamp_min(FLOOR).log()
        return blurred - self.log_mean[frame].float() + (change if time_us >= opens else -change)
