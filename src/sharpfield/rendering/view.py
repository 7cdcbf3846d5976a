"""A full image: one camera at one pose and time, drawn whole or in chunks of rays."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Radiance, Rays, Views
from sharpfield.geometry.rays import cast
from sharpfield.rendering.splat import whole

CHUNK = 4096
"""Rays rendered at once unless told otherwise; small enough for any machine."""

Progress = Callable[[int, int], None]
"""Told after each chunk how many pixels are done, and how many there are."""


@runtime_checkable
class ViewRenderer(Protocol):
    """A model that draws whole views, much faster than ray by ray."""

    def draw_views(self, views: Views) -> Radiance:
        """Linear light of views `[m, k]`, as `[m, h, w, k]`."""
        ...


@runtime_checkable
class RayRenderer(Protocol):
    """A model that renders scattered rays."""

    def render(self, rays: Rays) -> Radiance:
        """Linear light along rays."""
        ...


def renderer_of(model: RayRenderer) -> Callable[[Rays], Radiance] | ViewRenderer:
    """What `render_view` should ask of a model."""
    return model if isinstance(model, ViewRenderer) else model.render


@torch.no_grad()
def render_view(
    render: Callable[[Rays], Radiance] | ViewRenderer,
    camera: Camera,
    pose: Float[Tensor, "3 4"],
    time: float,
    *,
    rows: Float[Tensor, "q 3 4"] | None = None,
    chunk: int = CHUNK,
    progress: Progress | None = None,
) -> Radiance:
    """Sharp linear light at every pixel of a camera.

    Args:
        render: From rays to radiance, or something that draws the view whole; see `renderer_of`.
        camera: Gives the size of the image.
        pose: World-from-camera, in the renderer's world; the rays are made on its device.
        time: 0...1 of the capture.
        rows: Poses of a rolling shutter, see `Views`; only for what draws views.
        chunk: Rays rendered at once. Less needs less memory and gives the same image.
        progress: Called after each chunk.

    Returns:
        Radiance of shape `[h, w]` on the CPU, with what the coarse field sees left out.
    """
    pixels = camera.width * camera.height
    if isinstance(render, ViewRenderer):
        seen = render.draw_views(whole(camera, pose, time, rows))[0, :, :, 0].to("cpu")
        if progress is not None:
            progress(pixels, pixels)
        return seen
    xy = camera.grid(pose.device).reshape(-1, 2)
    parts = []
    for start in range(0, pixels, chunk):
        part = xy[start : start + chunk]
        ones = part.new_ones(len(part))
        seen = render(cast(camera, pose.expand(len(part), 3, 4), part, time * ones, ones))
        parts.append(Radiance(seen.rgb, seen.depth, seen.opacity, seen.weight).to("cpu"))
        if progress is not None:
            progress(min(start + chunk, pixels), pixels)
    return Radiance.cat(parts).reshape(camera.height, camera.width)
