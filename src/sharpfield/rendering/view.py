"""A full image: one camera at one pose and time, rendered in chunks of rays."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.radiance import Radiance
from sharpfield.core.rays import Rays
from sharpfield.geometry.cast import cast

CHUNK = 4096
"""Rays rendered at once unless told otherwise; small enough for any machine."""

Progress = Callable[[int, int], None]
"""Told after each chunk how many pixels are done, and how many there are."""


@torch.no_grad()
def render_view(
    render: Callable[[Rays], Radiance],
    camera: Camera,
    pose: Float[Tensor, "3 4"],
    time: float,
    *,
    chunk: int = CHUNK,
    progress: Progress | None = None,
) -> Radiance:
    """Sharp linear light at every pixel of a camera.

    Args:
        render: A model's `render`, or any other function from rays to radiance.
        camera: Gives the size of the image.
        pose: World-from-camera, in the renderer's world; the rays are made on its device.
        time: 0...1 of the capture.
        chunk: Rays rendered at once. Less needs less memory and gives the same image.
        progress: Called after each chunk.

    Returns:
        Radiance of shape `[h, w]` on the CPU, with what the coarse field sees left out.
    """
    xy = camera.grid(pose.device).reshape(-1, 2)
    parts = []
    for start in range(0, len(xy), chunk):
        part = xy[start : start + chunk]
        ones = part.new_ones(len(part))
        seen = render(cast(camera, pose.expand(len(part), 3, 4), part, time * ones, ones))
        parts.append(Radiance(seen.rgb, seen.depth, seen.opacity, seen.weight).to("cpu"))
        if progress is not None:
            progress(min(start + chunk, len(xy)), len(xy))
    return Radiance.cat(parts).reshape(camera.height, camera.width)
