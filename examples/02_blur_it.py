"""Blur is the mean of sharp light: the one formula, on a scene whose light is known.

    python examples/02_blur_it.py

finds the sharp rays that explain each pixel (`expose`), their light, and what the frame would store
(`observe`), for longer and longer exposures: `blur_it.png`. The last is compared with the frame of
the simulator, which shares no code with this.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro

import sharpfield as sf
from sharpfield.core.measurements import Pixels
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.tone import tone_of
from sharpfield.formation.shutter import Shutter
from sharpfield.simulation.scenes.static import Scene, scene
from sharpfield.storage.images import write_image

FRAME = 1


def main(size: tuple[int, int] = (120, 80), out: Path = Path("blur_it.png")) -> None:
    """Expose a frame for 0, 10, 25 and 50 ms."""
    capture = sf.simulate("garden", size=size, frames=2, test_every=0)
    frames, camera, garden = capture.needed_frames, capture.camera, scene("garden")
    tone = tone_of(frames.encoding).encode
    xy = camera.grid().reshape(-1, 2)  # every pixel
    opened, closed = capture.frame_time[FRAME][:, None].expand(2, len(xy))
    frame = torch.full((len(xy),), FRAME)
    whole = Pixels(xy, frame, torch.zeros_like(frame), opened, closed, torch.zeros(len(xy), 3))

    images = []
    for part, instants in ((0.0, 1), (0.2, 5), (0.5, 13), (1.0, 25)):
        half = part * (closed - opened) / 2
        seen = replace(whole, open=whole.middle - half, close=whole.middle + half)
        shutter = Shutter(camera, capture.trajectory, instants, tone)
        rays = shutter.expose(seen)  # [b, k], each with a weight of 1/k
        stored = shutter.observe(light_along(rays, garden, 1 / camera.fx_px), seen)
        images.append(np.uint8((255 * stored).round()).reshape(frames.images[FRAME].shape))

    apart = np.abs(np.int16(images[-1]) - frames.images[FRAME])
    print(f"from the simulated frame: {apart.mean():.2f} of 255 on average, {apart.max()} at most")
    write_image(out, np.hstack(images))
    print(f"wrote {out}")


def light_along(rays: Rays, garden: Scene, footprint_rad: float) -> Radiance:
    """What a renderer would return."""
    ends = (part.reshape(-1, 3).double().numpy() for part in (rays.origin, rays.direction))
    rgb, depth = (torch.from_numpy(a) for a in garden.light(*ends, footprint_rad=footprint_rad))
    depth = depth.reshape(rays.shape)
    return Radiance(rgb.reshape(*rays.shape, 3), depth, torch.ones_like(depth), rays.weight)


if __name__ == "__main__":
    tyro.cli(main)
