"""Render a full image of one camera at one pose and time, as a view or in chunks of rays."""

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
"""Rays rendered at once by default; small enough for any machine."""

Progress = Callable[[int, int], None]
"""Called after each chunk with the number of finished pixels, and of all pixels."""


@runtime_checkable
class ViewRenderer(Protocol):
    """A model that renders whole views, much faster than ray by ray."""

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
    """The renderer of a model that `render_view` uses."""
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
        render: From rays to radiance, or a renderer of whole views; see `renderer_of`.
        camera: Gives the size of the image.
        pose: World-from-camera, in the renderer's world; the rays are made on its device.
        time: 0...1 of the capture.
        rows: Poses of a rolling shutter, see `Views`; only for renderers of whole views.
        chunk: Rays rendered at once. Fewer need less memory and give the same image.
        progress: Called after each chunk.

    Returns:
        Radiance of shape `[h, w]` on the CPU, without that of the coarse stage.
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
