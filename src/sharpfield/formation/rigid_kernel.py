"""Rigid blurring kernel: blur as a few rigid motions of the camera, learned for each image.

Every pixel of an image is the weighted mean of its ray under the same few small rigid motions: the
first ray (the *origin*) is unmoved, the motions of the others are twists that a network computes
from a learned code of the image.

Sources: DP-NeRF (CVPR 2023), section 3.2 (rigid blurring kernel); Ev-DeblurNeRF (CVPR 2024), which
uses nine motions and the origin. Initial values and the order of the outputs are those of the
released code.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.measurements import Pixels
from sharpfield.core.protocols import Trajectory
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.tone import Curve, identity
from sharpfield.formation.mixing import mix
from sharpfield.geometry import se3
from sharpfield.geometry.rays import cast
from sharpfield.ops.dense import Dense, FrameVectors

ORIGIN = 0
"""Index of the unmoved ray, at the pose of the middle of the exposure."""

HEAD_BOUND = 1e-5
"""First weights of the motion heads, uniform in plus and minus this; see `RigidMotions`."""

Centre = Literal["world", "camera"]


class RigidMotions(nn.Module):
    """A few rigid motions and their weights for each image, computed from its learned code.

    The codes start at zero, so all images start equal. The weights of the motion heads start near
    zero but their biases do not, so the motions start slightly off the identity: by up to
    `window / sqrt(width)`, 0.0177 rad or units on each axis.

    Args:
        frames: Images of the capture.
        motions: Learned motions, in addition to the origin.
        code: Width of an image's code.
        width: Of the hidden layer of each of the three branches.
        window: Factor on the network's twists, rad and world units.
        generator: Where the first parameters come from.
    """

    def __init__(
        self,
        frames: int,
        *,
        motions: int = 9,
        code: int = 32,
        width: int = 32,
        window: float = 0.1,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.motions, self.window = motions, window
        self.codes = FrameVectors(frames, code)
        self.rotation = Dense([code, width, 3 * motions], generator=generator)
        self.translation = Dense([code, width, 3 * motions], generator=generator)
        self.weight = Dense([code, width, motions + 1], generator=generator)
        for branch in (self.rotation, self.translation):
            *_, weight, _ = branch.parameters()
            nn.init.uniform_(weight, -HEAD_BOUND, HEAD_BOUND, generator=generator)

    @property
    def rays(self) -> int:
        """Rays for each pixel: the origin and one for each motion."""
        return self.motions + 1

    def forward(self) -> tuple[Float[Tensor, "n k 3 4"], Float[Tensor, "n k"]]:
        """Motions (the first is the identity) and weights (they sum to one) of all images."""
        code = self.codes.vectors
        twist = torch.cat([self._axes(self.rotation(code)), self._axes(self.translation(code))], -1)
        twist = nn.functional.pad(self.window * twist, (0, 0, 1, 0))  # [n, k, 6], origin first
        weight = self.weight(code).sigmoid()
        return se3.exp(twist), weight / (weight.sum(-1, keepdim=True) + 1e-10)

    def _axes(self, head: Float[Tensor, "n o"]) -> Float[Tensor, "n m 3"]:
        """The head's outputs come axis by axis: all x, then all y, then all z."""
        return head.view(-1, 3, self.motions).transpose(-1, -2)


@dataclass(frozen=True)
class RigidKernel:
    """Blurred pixels as the weighted mean of rigidly moved rays."""

    camera: Camera
    trajectory: Trajectory
    motions: RigidMotions
    tone: Curve = identity
    centre: Centre = "world"
    """Centre of the rotations: the origin of the model's world, as released, or the camera, in its
    own axes."""

    def expose(self, seen: Pixels) -> Rays:
        """Rays `[b, k]`: the origin, then one for each motion, all at the middle of the exposure.

        The network runs once for each image of the capture, not for each pixel.
        """
        motion, weight = self.motions()
        motion, weight = motion[seen.frame], weight[seen.frame]  # [b, k, 3, 4], [b, k]
        time = seen.middle[:, None].expand_as(weight)
        pose = self.trajectory.pose(seen.middle, seen.track)[:, None].expand_as(motion)
        parts = (motion, pose) if self.centre == "world" else (pose, motion)
        return cast(self.camera, se3.compose(*parts), seen.xy[:, None], time, weight)

    def observe(self, radiance: Radiance, seen: Pixels) -> Float[Tensor, "b c"]:
        """The stored value of the mixed light."""
        return mix(radiance, outer=self.tone)
