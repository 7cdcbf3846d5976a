"""Frames without a learned kernel: one instant, or the mean over a known or refined motion.

The light of a pixel is integrated while the shutter is open; `tone` is the curve by which the frame
stores it, applied after the sum, because blur averages light and not stored values.

Source: the physical model behind every method here, e.g. BAD-NeRF (CVPR 2023), eq. 5, with poses
from a `Trajectory`, which may be learned.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.measurements import Pixels
from sharpfield.core.protocols import Trajectory
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.tone import Curve, identity
from sharpfield.formation.mixing import mix
from sharpfield.geometry.rays import cast


@dataclass(frozen=True)
class Pinhole:
    """A frame without blur: one ray per pixel, at the middle of the exposure."""

    camera: Camera
    trajectory: Trajectory
    tone: Curve = identity

    def expose(self, seen: Pixels) -> Rays:
        """One ray of weight one for each pixel, `[b, 1]`."""
        return expose_at(self.camera, self.trajectory, seen, seen.middle[:, None])

    def observe(self, radiance: Radiance, seen: Pixels) -> Float[Tensor, "b c"]:
        """The stored value."""
        return mix(radiance, outer=self.tone)


@dataclass(frozen=True)
class Shutter:
    """A blurred frame: the mean of `samples` instants of the exposure along the trajectory.

    The exposure is divided into `samples` equal parts with one ray in the middle of each (the
    midpoint rule, whose error falls with the square of their number). With an odd number, ray
    `samples // 2` is the middle of the exposure.
    """

    camera: Camera
    trajectory: Trajectory
    samples: int
    tone: Curve = identity

    def expose(self, seen: Pixels, generator: torch.Generator | None = None) -> Rays:
        """Rays `[b, samples]` of equal weight, ascending in time.

        Args:
            seen: Pixels with their exposures.
            generator: Moves each instant to a random time in its part of the exposure, which
                turns the error of the rule into noise of zero mean. On the device of the pixels.
        """
        part = torch.arange(self.samples, device=seen.device, dtype=seen.open.dtype)
        part = part.expand(len(seen), -1)  # [b, samples]
        if generator is None:
            part = part + 0.5
        else:
            part = part + torch.rand(
                part.shape, generator=generator, device=part.device, dtype=part.dtype
            )
        duration = seen.close - seen.open
        time = seen.open[:, None] + duration[:, None] * (part / self.samples)
        return expose_at(self.camera, self.trajectory, seen, time)

    def observe(self, radiance: Radiance, seen: Pixels) -> Float[Tensor, "b c"]:
        """The stored value of the mean light."""
        return mix(radiance, outer=self.tone)


def expose_at(
    camera: Camera, trajectory: Trajectory, seen: Pixels, time: Float[Tensor, "b k"]
) -> Rays:
    """Rays of pixels at given times, equal weights that sum to one.

    Args:
        camera: Lens and sensor.
        trajectory: Poses of the camera.
        seen: The pixels; their own exposure is not used.
        time: 0...1 of the capture.
    """
    track = seen.track[:, None].expand_as(time)
    weight = torch.full_like(time, 1 / time.shape[1])
    return cast(camera, trajectory.pose(time, track), seen.xy[:, None], time, weight)
