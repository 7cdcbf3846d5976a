"""Whole views of a blurred frame, and of windows of events: which to render, what is measured.

To images what `shutter.Shutter` and `events.EventPixel` are to single pixels. *Expose* turns the
instants of a batch into views, posed where the camera was; with a rolling shutter they carry the
poses of its rows. *Observe* turns the light of the rendered views into what the sensor reports:

    frame   tone(gain * mean over the exposure of L)
    events  log R(L at the end of the window) - log R(L at its start)
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.measurements import EventPairs, Instants, Pixels
from sharpfield.core.protocols import Response
from sharpfield.core.rays import Radiance, Views
from sharpfield.core.tone import Curve
from sharpfield.formation.mixing import mix, mix_with_few_gradients
from sharpfield.geometry.rolling import Rolling


@dataclass(frozen=True)
class ExposureOfViews:
    """A frame whose exposure is explained by several whole views.

    Source: the physical model of BAD-NeRF (CVPR 2023), eq. 5.
    """

    shutter: Rolling
    tone: Curve
    """Linear light to what frames store."""
    log_gain: Float[Tensor, "f"] | None = None
    """Natural log of how bright each frame of the capture was exposed."""

    def expose(self, seen: Instants) -> Views:
        """Views `[m, k]` at the instants."""
        return views_at(self.shutter, seen, seen.time)

    def observe(
        self, light: Radiance, seen: Pixels, no_grad: Radiance | None = None
    ) -> Float[Tensor, "m h w c"]:
        """The blurred frames `[m, h, w, c]` as stored.

        A mean of few views is not that over the exposure: if it had to equal the blurred frame
        whatever the instants, a scene that is itself a little blurred would do best. So further
        views, rendered without gradient, count in the mean, and the few carry its gradient.

        Args:
            light: Of the views with gradient, `[m, h, w, k]`.
            seen: The frames' pixels, `[m, h, w]`.
            no_grad: Of the further views.
        """
        mean = mix(light) if no_grad is None else mix_with_few_gradients(light, no_grad)
        return self.tone(self._brightened(mean, seen.frame[:, 0, 0]))

    def observe_each(self, light: Radiance, seen: Pixels) -> Float[Tensor, "m h w k c"]:
        """Each view as stored, as if it were a sharp frame of its own.

        Args:
            light: `[m, h, w, k]`.
            seen: The pixels of latent frames, `[m, h, w, k]`.
        """
        return self.tone(self._brightened(light.rgb, seen.frame[:, 0, 0, 0]))

    def _brightened(self, light: Float[Tensor, "m *b c"], frame: Int64[Tensor, "m"]) -> Tensor:
        """Light as bright as each frame was exposed."""
        if self.log_gain is None:
            return light
        return light * self.log_gain[frame].exp().reshape(-1, *[1] * (light.ndim - 1))


@dataclass(frozen=True)
class EventWindow:
    """The change of log light of every pixel from one instant to the next."""

    shutter: Rolling
    response: Response
    """Light to the log of what a pixel reports."""

    def expose(self, seen: Instants, time: Float[Tensor, "m k"]) -> Views:
        """Views `[m, k]` at the ends of the windows.

        Args:
            seen: The instants by the clock of the events.
            time: The same by the clock of the frames, 0...1 of the capture.
        """
        return views_at(self.shutter, seen, time)

    def observe(self, light: Radiance, seen: EventPairs) -> Float[Tensor, "m q h w c"]:
        """The change of log light over each window at every pixel.

        Args:
            light: Of the views, `[m, h, w, q + 1]`.
            seen: The windows, `[m, q, h, w, c]`; c = 3 behind a colour filter.
        """
        first = seen[:, 0].reshape(-1)  # the pixels of one window stand for all: [m h w c]
        rgb = light.rgb.flatten(0, 2).repeat_interleave(seen.shape[-1], 0)  # [m h w c, q + 1, rgb]
        log = self.response(rgb, first)[..., 0]  # [m h w c, q + 1]
        change = (log[:, 1:] - log[:, :-1]).reshape(*seen[:, 0].shape, -1)  # [m, h, w, c, q]
        return torch.movedim(change, -1, 1)


def views_at(shutter: Rolling, seen: Instants, time: Float[Tensor, "m k"]) -> Views:
    """The views of some instants as if they were taken at other times.

    Args:
        shutter: Of the camera that moves.
        seen: Whose tracks, weights and crops they have.
        time: Of the first row, 0...1 of the capture.
    """
    pose, rows = shutter.pose(time, seen.track), shutter.rows(time, seen.track)
    return Views(pose, time, seen.weight, seen.corner, seen.size, rows=rows)
