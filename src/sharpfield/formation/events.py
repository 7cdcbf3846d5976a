"""The event sensor: the change of log intensity between two instants of a pixel.

At an event, the log of the light at its pixel has changed by the contrast threshold since the
pixel's previous event. So two instants and the events between them measure a difference of two
logarithms, which is the image formation formula with weights -1 and +1.

Source: Ev-DeblurNeRF (CVPR 2024), event-by-event supervision; EventNeRF (CVPR 2023) for colour.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.measurements import EventPairs
from sharpfield.core.protocols import Response, Trajectory
from sharpfield.core.rays import Radiance, Rays
from sharpfield.formation.mixing import mix
from sharpfield.geometry.rays import cast


@dataclass(frozen=True)
class LogContrast:
    """Predicted change of log intensity between the two times of each pair."""

    camera: Camera
    trajectory: Trajectory
    response: Response
    """Light to the logarithm of the photoreceptor's output."""

    def expose(self, seen: EventPairs) -> Rays:
        """Rays `[b, 2]`: at the start with weight -1, at the end with weight +1."""
        time = torch.stack([seen.start, seen.end], -1)
        track = seen.track[:, None].expand_as(time)
        weight = time.new_tensor([-1.0, 1.0]).expand_as(time)
        pose = self.trajectory.pose(time, track)
        return cast(self.camera, pose, seen.xy[:, None], time, weight)

    def observe(self, radiance: Radiance, seen: EventPairs) -> Float[Tensor, "b 1"]:
        """The change from start to end; natural log."""
        return mix(radiance, inner=lambda light: self.response(light, seen))


@dataclass(frozen=True)
class ChainedContrast:
    """The same for runs of consecutive pairs: `m + 1` rays instead of `2 m`.

    Measurements are `[b, m]` pairs of one pixel each, every pair beginning where the one before it
    ends, so that each instant is rendered once for two pairs.
    """

    contrast: LogContrast

    def expose(self, seen: EventPairs) -> Rays:
        """Rays `[b, m + 1]`: every start and the last end.

        Their weights -1, 0, ..., 0, +1 are those of the change over the whole run.
        """
        time = torch.cat([seen.start, seen.end[:, -1:]], -1)
        track = seen.track[:, :1].expand_as(time)
        weight = torch.zeros_like(time)
        weight[:, 0], weight[:, -1] = -1, 1
        pose = self.contrast.trajectory.pose(time, track)
        return cast(self.contrast.camera, pose, seen.xy[:, :1], time, weight)

    def observe(self, radiance: Radiance, seen: EventPairs) -> Float[Tensor, "n 1"]:
        """The change over each pair, in the order of `seen.reshape(-1)`; natural log."""
        first = torch.arange(seen.shape[1], device=seen.device)
        ends = radiance[:, torch.stack([first, first + 1], -1)].reshape(-1, 2)  # [b m, 2]
        weight = ends.weight.new_tensor([-1.0, 1.0]).expand_as(ends.weight)
        return self.contrast.observe(replace(ends, weight=weight), seen.reshape(-1))
