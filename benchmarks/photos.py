"""Blurred photos of unknown motion, and sharp ones to compare with: `blur-splat` on real scenes.

    python -m benchmarks.photos SCENE [--minutes 10] [--shrink 2] [--recipes blur-splat splat]

SCENE is a folder of Deblur-NeRF's layout. Held-out views are measured from the poses that structure
from motion gave them, and again after those were refined on the finished model, as the papers do
whose own poses move while they learn.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped
from rich.console import Console

from benchmarks.table import Row, save, show
from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.frames import Frames
from sharpfield.evaluation.measure import EvaluationOptions, evaluate
from sharpfield.evaluation.options import Refinement
from sharpfield.evaluation.refine import aligned_poses, refine_poses
from sharpfield.recipes.settings.presets import prepared
from sharpfield.runs.config import RunConfig
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.training.options import TrainingOptions

REFINED = Refinement(steps=200, rate=5e-4, every=50)


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--shrink", type=int, default=2)
    parser.add_argument("--recipes", nargs="+", default=["splat", "blur-splat"])
    parser.add_argument("--out", type=Path, default=Path("runs/photos"))
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    capture = downscaled(read_capture(asked.scene), asked.shrink)
    folder = asked.out / "capture"
    native.write(capture, folder)
    rows: list[Row] = []
    for name in asked.recipes:
        run = asked.out / name
        recipe = prepared(name, "draft", capture=native.read(folder), device="cpu")
        started = RunConfig(name, recipe, str(folder.resolve()), asked.seed)
        options = TrainingOptions(minutes=asked.minutes)
        train_run(started, native.read(folder), run, options, device="cpu", console=Console())
        rows.append(_row(name, run))
    show(rows)
    facts = {"scene": asked.scene.name, "minutes": asked.minutes, "shrink": asked.shrink}
    print(save(f"photos_{asked.scene.name}", rows, {k: str(v) for k, v in facts.items()}))


def downscaled(capture: Capture, factor: int) -> Capture:
    """A capture whose frames have a fraction of the width and height.

    Stored values are averaged as they are, which is how published data sets were made smaller.

    Args:
        capture: Frames only; counts of events do not add up over pixels.
        factor: Pixels to each side that become one; what is left over at the border is cut off.

    Raises:
        OptionError: There are events, or the factor is larger than the image.
    """
    frames = capture.needed_frames
    if capture.events is not None:
        raise OptionError(
            "captures with events cannot be made smaller",
            where=capture.name,
            got=f"{len(capture.events)} events",
            do="leave the events out, or use the full size",
        )
    width, height = frames.width // factor, frames.height // factor
    if factor < 1 or not (width and height):
        raise OptionError(
            "frames cannot be made that small",
            where=capture.name,
            got=f"{frames.width}x{frames.height} by {factor}",
        )
    camera = replace(
        capture.camera,
        width=width,
        height=height,
        **{
            name: getattr(capture.camera, name) / factor
            for name in ("fx_px", "fy_px", "cx_px", "cy_px")
        },
    )

    def small(images: Shaped[np.ndarray, "n h w c"]) -> Shaped[np.ndarray, "n y x c"]:
        cut = np.asarray(images)[:, : height * factor, : width * factor]
        resized = [cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA) for one in cut]
        return np.stack(resized).reshape(len(cut), height, width, -1)

    smaller: Frames = replace(
        frames,
        images=small(frames.images),
        truth=None if frames.truth is None else small(frames.truth),
        depth=None,
        flow=None,
        blur_px=None if frames.blur_px is None else frames.blur_px / factor,
    )
    return replace(capture, camera=camera, frames=smaller)


def _row(name: str, run: Path) -> Row:
    opened = open_run(run, capture=None, device="cpu")
    before = evaluate(opened.model, opened.capture, run)
    begin = aligned_poses(opened.model, opened.capture)
    found = refine_poses(opened.model, opened.capture, options=REFINED, start=begin)
    how = EvaluationOptions(poses=found.poses, stated=found.protocol)
    after = evaluate(opened.model, opened.capture, run, options=how)
    return {
        "recipe": name,
        "psnr": before["mean"]["psnr"],
        "ssim": before["mean"]["ssim"],
        "psnr, refined poses": after["mean"]["psnr"],
        "ssim, refined poses": after["mean"]["ssim"],
        "steps": after["train"]["steps"],
        "seconds": after["train"]["seconds"],
    }


if __name__ == "__main__":
    main()
