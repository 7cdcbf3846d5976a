"""Inside `sf.train`: a recipe, its model, the training loop, a rendered view.

    python examples/01_a_sharp_scene.py

records a scene with a shaky camera, trains on it for some seconds, and writes `a_sharp_scene.png`:
a blurry frame, the learned view from the same pose, and the sharp truth.
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import sharpfield as sf
from sharpfield.metrics.image import psnr
from sharpfield.recipes.settings.presets import prepared
from sharpfield.rendering.view import render_view
from sharpfield.report.colormaps import eight_bit
from sharpfield.storage.images import write_image
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam


def main(
    size: tuple[int, int] = (96, 64), steps: int = 200, out: Path = Path("a_sharp_scene.png")
) -> None:
    """Record, train, render."""
    capture = sf.simulate("garden", size=size, frames=10, motion="shaky", seed=0)
    frames = capture.needed_frames

    # A recipe holds the options of a paper; presets shrink them to what a CPU can do.
    recipe = prepared("ev-deblur-nerf", "physical,draft", capture=capture, device="cpu")
    model = recipe.lasting(steps).build(capture, seed=0)
    fit(model, adam(model), steps=range(steps))

    # The model has a capture of its own: the same cameras in the space that it is trained in.
    frame = int(capture.split.train[4])
    middle = float(capture.frame_time[frame].mean())
    pose = model.capture.frame_pose(np.array([frame]))[0]
    light = render_view(model.render, capture.camera, pose, middle).rgb
    learned = eight_bit(model.encode(light).detach().numpy())

    images = {"blurry": frames.images[frame], "learned": learned, "truth": frames.truth[frame]}
    values = {name: torch.from_numpy(np.float32(p)) / 255 for name, p in images.items()}
    for name in ("blurry", "learned"):
        print(f"{name:8} PSNR {psnr(values[name], values['truth']):.2f} dB")
    write_image(out, np.hstack(list(images.values())))
    print(f"wrote {out}")


if __name__ == "__main__":
    tyro.cli(main)
