"""Images of Gaussians through lenses with distortion, resampled from pinhole images.

A *flat* image is that of a pinhole camera with the same pose, just wide and fine enough. Every
pixel of the real camera takes the bilinear interpolation of the flat image at the position of its
ray. Both have the same optical axis, so that depth along it stays the same.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.errors import OptionError
from sharpfield.ops.rasterizer import Canvas, Drawn

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
    focal = _finest(plane)
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


def _finest(plane: Float[Tensor, "h w 2"]) -> float:
    """Pixels per unit of the plane z = 1, where they are densest."""
    steps = [plane[:, 1:] - plane[:, :-1], plane[1:] - plane[:-1]]
    return max(1 / float(step.norm(dim=-1).min()) for step in steps)
