"""From blurry frames and events to a sharp scene.

    python examples/01_a_sharp_scene.py

records a scene with a shaky camera, learns it for some seconds, and writes `a_sharp_scene.png`: a
blurry frame, the learned scene from the same place, and what was really there. The same from the
command line, with a report: `sharpfield simulate`, `sharpfield train`, `sharpfield evaluate`.
"""

from pathlib import Path

import numpy as np
import torch
import tyro

from sharpfield.metrics.image import psnr
from sharpfield.recipes.settings.presets import prepared
from sharpfield.rendering.view import render_view
from sharpfield.report.colormaps import eight_bit
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.storage.images import write_image
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam


def main(
    size: tuple[int, int] = (96, 64), steps: int = 200, out: Path = Path("a_sharp_scene.png")
) -> None:
    """Record, learn, look."""
    capture = simulate("garden", "shaky", rig=Rig(size), timing=Timing(frames=10), seed=0)
    frames = capture.needed_frames

    # A recipe is a paper's numbers; presets shrink them to what this machine can take.
    recipe = prepared("ev-deblur-nerf", "physical,draft", capture=capture, device="cpu")
    model = recipe.lasting(steps).build(capture, seed=0)
    fit(model, adam(model), steps=range(steps))

    # The model has its own capture: the same cameras in the space that it learned in.
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
