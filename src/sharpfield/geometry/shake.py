"""Motion of the camera inside each exposure, where nothing but the blur tells of it."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.protocols import Trajectory
from sharpfield.geometry import se3, spline


class LearnedShake(nn.Module):
    """A trajectory whose tracks are photos, each with a learned motion while its shutter is open.

    The motion is a cubic B-spline of twists in camera axes over the exposure; outside of it the
    camera stands still.

    Args:
        base: Where each photo was taken.
        opens: When each track's shutter opened, 0...1 of the capture.
        closes: When it closed; later.
        knots: Of each spline, at least 4.
        start: First twists; small random ones, as a motion that is exactly zero never learns.

    Source: BAD-NeRF (CVPR 2023) for the idea, with a line or a spline between the ends.
    """

    opens: Tensor
    closes: Tensor

    def __init__(
        self,
        base: Trajectory,
        opens: Float[Tensor, "n"],
        closes: Float[Tensor, "n"],
        *,
        knots: int,
        start: Float[Tensor, "n m 6"] | None = None,
    ) -> None:
        super().__init__()
        self.base = base
        self.register_buffer("opens", opens, persistent=False)
        self.register_buffer("closes", closes, persistent=False)
        zeros = torch.zeros(len(opens), knots, 6)
        self.twist = nn.Parameter(zeros if start is None else start.clone())

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera, moved as learned."""
        segments = self.twist.shape[1] - 3
        opens, closes = self.opens[track], self.closes[track]
        place = ((time - opens) / (closes - opens)).clamp(0, 1) * segments
        i = place.detach().long().clamp(0, segments - 1)
        near = i[..., None] + torch.arange(4, device=time.device)
        weights = spline.bspline_weights(place - i)
        twist = (weights[..., None] * self.twist[track[..., None], near]).sum(-2)
        return se3.compose(self.base.pose(time, track), se3.exp(twist))

    def known_us(self, track: int) -> tuple[int, int] | None:
        """As the base's."""
        return self.base.known_us(track)
