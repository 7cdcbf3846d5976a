"""Deformable sparse kernel: blur as a few displaced rays of each pixel, learned for each image.

Each image has a few *canonical* points around a pixel. A network displaces them, gives each a
weight and shifts the origin of its ray a little, depending on the image's learned code and on the
position of the pixel in the image; so the kernel may vary across the image.

Source: Deblur-NeRF (CVPR 2022), section 3.2 (deformable sparse kernel), 3.3 (ray origins) and 3.4
(alignment).
"""

from dataclasses import dataclass
from typing import ClassVar

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
