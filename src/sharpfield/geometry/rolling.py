"""Poses of a camera with a rolling shutter, which reads an image row by row.

The times of a frame or view are those of its first row; the last row follows after the *readout*
time. The pose of a view is that of its middle row.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry import se3

KNOTS = 5
"""Poses over a readout; the motion between two of them is taken as uniform."""


@dataclass(frozen=True)
class Rolling:
    """The shutter of one capture."""

    trajectory: Trajectory
    readout: float
    """From the first row to the last, 0...1 of the capture; 0 reads all rows at once."""

    @classmethod
    def of(cls, capture: Capture, *, along: Trajectory | None = None) -> "Rolling":
        """That of a capture's frames; along another trajectory than its own if one is given."""
        frames = capture.frames
        readout = 0.0 if frames is None else frames.exposure.readout_us(frames.height)
        return cls(along or capture.trajectory, readout / capture.clock.span_us)

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """Poses at the time when the middle row is read."""
        return self.trajectory.pose(time + self.readout / 2, track)

    def rows(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b q 3 4"] | None:
        """Poses from the first row to the last, evenly in time; None for a global shutter.

        Args:
            time: Of the first row, 0...1 of the capture.
            track: Whose camera.
        """
        if self.readout == 0:
            return None
        fraction = torch.linspace(0, 1, KNOTS, device=time.device, dtype=time.dtype)
        times = time[..., None] + self.readout * fraction  # [*b, q]
        return self.trajectory.pose(times, track[..., None].expand_as(times))


def moved_rows(
    rows: Float[Tensor, "q 3 4"] | None, start: Float[Tensor, "3 4"], pose: Float[Tensor, "3 4"]
) -> Float[Tensor, "q 3 4"] | None:
    """The poses of the rows of a view after the pose of the view was changed."""
    if rows is None:
        return None
    moved = se3.compose(pose, se3.inverse(start.to(pose)))
    return se3.compose(moved.expand(len(rows), 3, 4), rows.to(pose))
