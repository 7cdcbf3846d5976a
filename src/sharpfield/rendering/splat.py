"""Views of Gaussians, by rasterization, through any lens and with a global or rolling shutter.

The colours of Gaussians are *stored* values, as in frames and in the files of splat viewers; a tone
curve turns them into linear light before they are blended, because light adds up and stored values
do not. Depth is the distance along the optical axis, in world units.

Of a lens with distortion, a *flat* image is rendered: that of a pinhole camera with the same pose,
just wide and fine enough. Every pixel of the real camera takes its bilinear interpolation at the
position of the pixel's ray. Both have the same optical axis, so that depth along it stays the same.

With a rolling shutter, each Gaussian is projected with the pose at the time of its own row. The row
determines the time, and the pose at that time the row: a fixed-point iteration of two steps. Shape,
colour and depth order are those of the middle row's pose, as over a readout they hardly change.

Source: Seiskari et al., "Gaussian Splatting on the Move" (ECCV 2024), with the motion over the
readout as piecewise-linear poses instead of one velocity.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.errors import OptionError, need
from sharpfield.core.rays import Radiance, Views
from sharpfield.ops.rasterizer import NEAR, Canvas, Drawn, rasterize

STEEPEST = 5.0
"""Largest distance from the optical axis on the plane z = 1 that is rendered: 79 degrees."""

MOST_PIXELS = 4.0
"""Most pixels of a flat image per pixel of the real one; beyond, it is rendered coarser."""

RIM_PX = 2
"""Margin of the flat image beyond the outermost ray."""


@dataclass(frozen=True)
class Flat:
    """The flat image of a camera, and the position on it of each pixel of the camera."""

    camera: Camera
    """Without distortion."""
    where: Float[Tensor, "h w 2"]
    """In pixels of the flat image."""

    def canvas(
        self, corner: Int64[Tensor, "v 2"], size: tuple[int, int], *, antialiased: bool
    ) -> tuple[Canvas, Float[Tensor, "v h w 2"]]:
        """The canvas to render for parts of the real image, and their pixels' positions on it.

        Args:
            corner: Pixel at the upper left of each part.
            size: Width and height of the parts.
            antialiased: See `Canvas`.
        """
        width, height = size
        parts = [self.where[y : y + height, x : x + width] for x, y in corner.tolist()]
        where = torch.stack(parts).to(corner.device)
        first = (where.amin((1, 2)) - RIM_PX).floor().long()
        last = (where.amax((1, 2)) + RIM_PX).ceil().long()
        wide, high = (last - first).amax(0).tolist()
        on_part = where - first[:, None, None]
        return Canvas(self.camera, first, (wide, high), antialiased=antialiased), on_part


@lru_cache(maxsize=8)
def flattened(camera: Camera) -> Flat:
    """The flat image for a camera: as fine as the finest part of the real one.

    Raises:
        OptionError: The field of view is too wide for a pinhole image.
    """
    ray = camera.direction(camera.grid().double())
    ahead = ray[..., 2:] > 0
    plane = torch.where(ahead, ray[..., :2] / ray[..., 2:].clamp_min(1e-9), torch.inf)
    if not (plane.norm(dim=-1) < STEEPEST).all():
        angle = torch.rad2deg(torch.acos(ray[..., 2].min()))
        raise OptionError(
            "the field of view is too wide for images of Gaussians",
            got=f"{angle:.0f} degrees from the optical axis at the corner",
            do="crop the recording to 75 degrees, or use a recipe that renders rays",
        )
    low, high = plane.amin((0, 1)), plane.amax((0, 1))
    steps = [plane[:, 1:] - plane[:, :-1], plane[1:] - plane[:-1]]
    focal = max(1 / float(step.norm(dim=-1).min()) for step in steps)  # where pixels are densest
    pixels = float((high - low).prod()) * focal**2
    focal = focal * min(1.0, MOST_PIXELS * camera.width * camera.height / pixels) ** 0.5
    # Pixels of the two images coincide on the axis, where most lenses have next to no distortion.
    cx, cy = (
        centre + ceil(RIM_PX - min(float(edge), 0.0) * focal - centre)
        for edge, centre in zip(low, (camera.cx_px, camera.cy_px), strict=True)
    )
    wide, high = (
        ceil(centre + max(float(edge), 0.0) * focal + RIM_PX)
        for edge, centre in zip(high, (cx, cy), strict=True)
    )
    flat = Camera(wide, high, focal, focal, cx, cy)
    where = plane * focal + plane.new_tensor([cx, cy])
    return Flat(flat, where.float())


def resampled(drawn: Drawn, where: Float[Tensor, "v h w 2"]) -> Drawn:
    """Bilinear interpolation of a rendered image at positions on it."""
    height, width = drawn.opacity.shape[1:]
    flat = torch.cat([drawn.light, drawn.depth[..., None], drawn.opacity[..., None]], -1)
    span = where.new_tensor([width, height])
    seen = torch.nn.functional.grid_sample(
        flat.movedim(-1, 1), 2 * where / span - 1, padding_mode="border", align_corners=False
    ).movedim(1, -1)
    return Drawn(seen[..., :-2], seen[..., -2], seen[..., -1])


ROUNDS = 2
"""Fixed-point steps; each multiplies the error by about the motion over a readout, in images."""


def row_shift(
    means: Float[Tensor, "n 3"],
    pose: Float[Tensor, "v 3 4"],
    rows: Float[Tensor, "v q 3 4"],
    camera: Camera,
    flat: Camera,
    drift: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "v n 2"]:
    """Shift of splats, in pixels, relative to a global shutter at the middle row's pose.

    Args:
        means: In world axes.
        pose: World-from-camera, of the middle row.
        rows: From the first row to the last, evenly in time.
        camera: The camera with the rolling shutter.
        flat: The pinhole camera that is rendered.
        drift: How far each mean itself moves from the first row to the last; it passes through
            `means` at the middle row. None for static Gaussians.
    """
    last = rows.shape[1] - 1
    middle = _in_camera(means, pose[:, None])[:, 0]
    if drift is not None:
        fraction = torch.linspace(-0.5, 0.5, rows.shape[1], device=means.device, dtype=means.dtype)
        means = means + fraction[:, None, None] * drift  # [q, n, 3]
    by_row = _in_camera(means, rows)  # [v, q, n, 3]
    at, visible = middle, middle[..., 2] > NEAR
    for _ in range(ROUNDS):
        row = camera.project(_ahead(at, visible))[..., 1] / camera.height
        knot = row.clamp(0, 1) * last  # [v, n]
        before = knot.detach().floor().clamp_max(last - 1)
        one, other = (
            by_row.gather(1, (before + k).long()[:, None, :, None].expand(-1, 1, -1, 3))[:, 0]
            for k in (0, 1)
        )
        at = torch.lerp(one, other, (knot - before)[..., None])
        visible = visible & (at[..., 2] > NEAR)
    shift = flat.project(_ahead(at, visible)) - flat.project(_ahead(middle, visible))
    return torch.where(visible[..., None], shift, 0.0)


def _in_camera(
    means: Float[Tensor, "*r n 3"], poses: Float[Tensor, "v q 3 4"]
) -> Float[Tensor, "v q n 3"]:
    """Points in the axes of cameras."""
    return (means - poses[..., None, :, 3]) @ poses[..., :3]


def _ahead(points: Float[Tensor, "v n 3"], visible: Bool[Tensor, "v n"]) -> Float[Tensor, "v n 3"]:
    """Points that can be projected: those that are not visible are moved to the optical axis."""
    return torch.where(visible[..., None], points, points.new_tensor([0.0, 0.0, 1.0]))


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
