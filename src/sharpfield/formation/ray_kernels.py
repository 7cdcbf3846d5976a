"""Learned blur kernels for each image: every pixel is the weighted mean of a few moved rays.

*Rigid blurring kernel*: all pixels of an image share a few small rigid motions of the camera. The
first ray (the *origin*) is unmoved, the motions of the others are twists that a network computes
from a learned code of the image. *Deformable sparse kernel*: each image has a few *canonical*
points around a pixel. A network displaces them, gives each a weight and shifts the origin of its
ray a little, depending on the image's learned code and on the position of the pixel in the image;
so the kernel may vary across the image.

Sources: DP-NeRF (CVPR 2023), section 3.2 (rigid blurring kernel); Ev-DeblurNeRF (CVPR 2024), which
uses nine motions and the origin, initial values and order of the outputs from the released code;
Deblur-NeRF (CVPR 2022), section 3.2 (deformable sparse kernel), 3.3 (ray origins), 3.4 (alignment).
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.measurements import Pixels
from sharpfield.core.protocols import Trajectory
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.struct import Struct
from sharpfield.core.tone import Curve, identity
from sharpfield.formation.mixing import mix
from sharpfield.geometry import se3
from sharpfield.geometry.rays import cast
from sharpfield.ops.dense import Dense, FrameVectors
from sharpfield.ops.encoding import frequencies, frequencies_width

ORIGIN = 0
"""Index of the unmoved ray, at the pose of the middle of the exposure."""

HEAD_BOUND = 1e-5
"""First weights of the motion heads, uniform in plus and minus this; see `RigidMotions`."""


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
    centre: Literal["world", "camera"] = "world"
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


ORIGIN_STEP = 0.01
"""Factor on the network's shift of a ray's origin; world units."""

SPREAD, JITTER = 0.1, 0.1
"""Standard deviations, in windows: of the canonical points at first, and of the noise on them while
training, which keeps the network smooth."""

OCTAVES = 2
"""Of the encoding of a point and of its position in the image."""


@dataclass(frozen=True)
class Bend(Struct):
    """Displacement of each ray of a pixel, relative to the pixel's own ray."""

    trailing: ClassVar = {"offset_px": 1, "origin": 1}

    offset_px: Float[Tensor, "*b 2"]
    """Of its position in the image, relative to the pixel."""
    origin: Float[Tensor, "*b 2"]
    """Shift of its origin along the camera's x and y axes, world units."""
    weight: Float[Tensor, "*b"]


class SparsePoints(nn.Module):
    """The network that displaces rays.

    Args:
        frames: Images of the capture.
        size: (width, height) of the images.
        points: Rays for each pixel.
        code: Width of an image's code.
        width: Of the four hidden layers; the input is concatenated again after them.
        window_px: Unit of the canonical points, about the half width of a kernel.
        generator: Where the first parameters come from.
    """

    def __init__(
        self,
        frames: int,
        size: tuple[int, int],
        *,
        points: int = 5,
        code: int = 32,
        width: int = 64,
        window_px: float = 10.0,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.size, self.window_px = size, window_px
        self.codes = FrameVectors(frames, code)
        first = SPREAD * torch.randn(frames, points, 2, generator=generator)
        self.canonical = nn.Parameter(first)
        inputs = code + 2 * frequencies_width(2, OCTAVES)
        self.network = Dense([inputs, *4 * [width], 5], generator=generator, skips=(4,))

    def forward(self, seen: Pixels, generator: torch.Generator | None = None) -> Bend:
        """Displacements of each pixel's rays; with a generator, the points are jittered."""
        point = self.canonical[seen.frame]  # [b, k, 2]
        if generator is not None:
            noise = torch.randn(
                point.shape, generator=generator, device=point.device, dtype=point.dtype
            )
            point = point + JITTER * noise
        position = 2 * seen.xy / seen.xy.new_tensor(self.size) - 1  # -1...1
        of_pixel = torch.cat([self.codes(seen.frame), frequencies(position, OCTAVES)], -1)
        of_pixel = of_pixel[:, None].expand(-1, point.shape[1], -1)
        out = self.network(torch.cat([frequencies(point, OCTAVES), of_pixel], -1))
        offset, origin, weight = out.split([2, 2, 1], -1)
        return Bend(
            offset_px=self.window_px * point + offset,
            origin=ORIGIN_STEP * origin,
            weight=weight[..., 0].softmax(-1),
        )


@dataclass(frozen=True)
class SparseKernel:
    """Blurred pixels as the weighted mean of a few displaced rays."""

    camera: Camera
    trajectory: Trajectory
    points: SparsePoints
    tone: Curve = identity

    def expose(self, seen: Pixels) -> Rays:
        """Rays `[b, k]`, all at the middle of the exposure."""
        return self.follow(self.points(seen), seen)

    def follow(self, bend: Bend, seen: Pixels) -> Rays:
        """Rays of given displacements, for recipes that also regularise them (`alignment`)."""
        time = seen.middle[:, None].expand_as(bend.weight)
        pose = self.trajectory.pose(seen.middle, seen.track)[:, None]
        pose = pose.expand(*bend.weight.shape, 3, 4)
        rays = cast(self.camera, pose, seen.xy[:, None] + bend.offset_px, time, bend.weight)
        shift = se3.rotate(pose, nn.functional.pad(bend.origin, (0, 1)))
        return Rays(rays.origin + shift, rays.direction, rays.time, rays.weight)

    def observe(self, radiance: Radiance, seen: Pixels) -> Float[Tensor, "b c"]:
        """The stored value of the mixed light."""
        return mix(radiance, outer=self.tone)
