"""Views of Gaussians, by rasterization.

The colours of Gaussians are *stored* values, as in frames and in the files of splat viewers; a tone
curve turns them into linear light before they are blended, because light adds up and stored values
do not. Depth is the distance along the optical axis, in world units.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.errors import need
from sharpfield.core.rays import Radiance, Views
from sharpfield.ops.rasterizer import Canvas, rasterize
from sharpfield.rendering.splat_lens import flattened, resampled
from sharpfield.rendering.splat_rolling import row_shift


@runtime_checkable
class Cloud(Protocol):
    """Gaussians, as `fields.Gaussians` holds them."""

    @property
    def means(self) -> Float[Tensor, "n 3"]:
        """Their centres."""
        ...

    @property
    def quaternions(self) -> Float[Tensor, "n 4"]:
        """Their rotations, w x y z."""
        ...

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations."""
        ...

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """0...1."""
        ...

    def colours(self, seen_from: Float[Tensor, "v 3"]) -> Float[Tensor, "v n c"]:
        """Stored values seen from some positions, not below zero."""
        ...


@dataclass(frozen=True)
class Splatting:
    """Renders Gaussians with a camera of any lens, and a global or rolling shutter."""

    camera: Camera
    decode: Callable[[Tensor], Tensor]
    """Stored values to linear light."""
    background: float = 0.0
    """Light from behind everything, 0 black to 1 white."""
    antialiased: bool = True

    def __call__(
        self,
        cloud: Cloud,
        views: Views,
        shift: Float[Tensor, "v n 2"] | None = None,
        drift: Float[Tensor, "n 3"] | None = None,
    ) -> Radiance:
        """Linear light of views.

        Args:
            cloud: The Gaussians.
            views: `[m, k]`: the k views that explain each of m measurements.
            shift: Moves splats in pixels, see `ops.rasterizer`; v = m k.
            drift: How far Gaussians move while a rolling shutter reads an image, see `row_shift`.

        Returns:
            Radiance `[m, h, w, k]`.

        Raises:
            MissingExtra: On a GPU, without gsplat.
            OptionError: The field of view is too wide, see `flattened`.
        """
        if views.device.type == "cuda":
            # The reference implementation would run, and need more memory than any GPU has.
            need("gsplat", extra="gpu", purpose="drawing Gaussians on a GPU")
        m, k = views.shape
        poses = views.pose.reshape(-1, 3, 4)
        corner, where = views.corner.reshape(-1, 2), None
        if self.camera.lens == "pinhole":
            canvas = Canvas(self.camera, corner, views.size, antialiased=self.antialiased)
        else:
            flat = flattened(self.camera)
            canvas, where = flat.canvas(corner, views.size, antialiased=self.antialiased)
        if views.rows is not None:
            rows = views.rows.reshape(m * k, -1, 3, 4)
            rolling = row_shift(cloud.means, poses, rows, self.camera, canvas.camera, drift)
            shift = rolling if shift is None else shift + rolling
        drawn = rasterize(
            cloud.means,
            cloud.quaternions,
            cloud.scales,
            cloud.opacities,
            self.decode(cloud.colours(poses[:, :, 3])),
            poses,
            canvas,
            shift,
        )
        if where is not None:
            drawn = resampled(drawn, where)
        light, opacity = drawn.light, drawn.opacity
        if self.background:
            light = light + self.background * (1 - opacity[..., None])
        depth = drawn.depth / opacity.clamp_min(1e-6)
        weight = views.weight[:, None, None].expand(m, *opacity.shape[1:], k)

        def apart(values: Tensor) -> Tensor:
            """`[m k, ...]` to `[m, ..., k]`, or with channels last to `[m, h, w, k, c]`."""
            return values.unflatten(0, (m, k)).movedim(1, 3)

        return Radiance(apart(light), apart(depth), apart(opacity), weight)


def whole(
    camera: Camera,
    pose: Float[Tensor, "3 4"],
    time: float,
    rows: Float[Tensor, "q 3 4"] | None = None,
) -> Views:
    """The full image of a camera, as the only view of its measurement: `[1, 1]`."""
    if rows is not None:
        rows = rows[None, None]
    one = pose.new_ones(1, 1)
    corner = torch.zeros(1, 1, 2, dtype=torch.int64)
    return Views(pose[None, None], time * one, one, corner, camera.size, rows)
