"""All recipes on one capture, with the same time each: quality on views that none has seen.

    python -m benchmarks.recipes [--capture FOLDER] [--minutes 15] [--only ev-splat ...]

Without a capture one is simulated: 300x200 px, 26 frames. `splat, sharp frames` learns from the
true images in the middle of each exposure, which no camera could take: what perfect deblurring
of every single frame would give.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.table import Row, save, show
from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_capture
from sharpfield.cli.arguments import parse_size
from sharpfield.core.capture import Capture
from sharpfield.core.frames import Exposure
from sharpfield.recipes.settings.presets import prepared
from sharpfield.runs.config import RunConfig
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.simulation.sensors.event_pixels import SENSORS
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.training.options import TrainingOptions


@dataclass(frozen=True)
class Contender:
    """A recipe, and what it learns from."""

    name: str
    recipe: str
    preset: str = "draft"
    sharp: bool = False
    """It is given the true sharp images of the training frames."""


CONTENDERS = (
    Contender("splat", "splat"),
    Contender("splat, sharp frames", "splat", sharp=True),
    Contender("blur-splat", "blur-splat"),
    Contender("edi-splat", "edi-splat"),
    Contender("ev-deblur-nerf", "ev-deblur-nerf", "physical,draft"),
    Contender("ev-splat", "ev-splat"),
)


def simulated(size: str, sensor: str, seed: int) -> Capture:
    """The capture that is used without another one."""
    rig = Rig(parse_size(size), event_sensor=SENSORS[sensor])
    timing = Timing(frames=30, exposure_us=60_000, interval_us=66_000)
    return replace(simulate("garden", "shaky", rig=rig, timing=timing, seed=seed), name="garden")


def with_true_frames(capture: Capture) -> Capture:
    """The capture as a camera without motion blur would have taken it."""
    frames = capture.needed_frames
    assert frames.truth is not None, f"{capture.name} knows no sharp images"
    images = np.array(frames.images)
    train = capture.split.train
    truth = frames.truth[train]
    scale = frames.white if truth.dtype.kind == "f" else 1
    images[train] = np.rint(truth * scale).astype(images.dtype)
    middle = frames.exposure.middle_us
    return replace(
        capture, frames=replace(frames, images=images, exposure=Exposure(middle, middle))
    )


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--size", default="300x200")
    parser.add_argument("--sensor", default="dvs346")
    parser.add_argument("--out", type=Path, default=Path("runs/recipes"))
    parser.add_argument("--only", nargs="*", default=[contender.name for contender in CONTENDERS])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    capture = (
        read_capture(asked.capture)
        if asked.capture
        else simulated(asked.size, asked.sensor, asked.seed)
    )
    out = asked.out / capture.name
    folders = {"stored": out / "capture", "sharp": out / "capture-sharp"}
    native.write(capture, folders["stored"])
    native.write(with_true_frames(capture), folders["sharp"])
    rows: list[Row] = []
    for contender in CONTENDERS:
        if contender.name in asked.only:
            rows.append(_compete(contender, folders, out, asked))
            facts = {"capture": capture.name, "minutes": asked.minutes, "seed": asked.seed}
            print(
                save(
                    f"recipes_{capture.name}_{asked.minutes:g}min",
                    rows,
                    {k: str(v) for k, v in facts.items()},
                )
            )
    show(rows)


def _compete(
    contender: Contender, folders: dict[str, Path], out: Path, asked: argparse.Namespace
) -> Row:
    console = Console()
    source = folders["sharp" if contender.sharp else "stored"]
    run = out / contender.name.replace(", ", "-").replace(" ", "-")
    recipe = prepared(
        contender.recipe, contender.preset, capture=native.read(source), device=asked.device
    )
    started = RunConfig(contender.recipe, recipe, str(source.resolve()), asked.seed)
    options = TrainingOptions(minutes=asked.minutes)
    train_run(started, native.read(source), run, options, device=asked.device, console=console)
    opened = open_run(run, capture=None, device=asked.device)
    opened = replace(opened, capture=native.read(folders["stored"]))
    metrics = opened.evaluate(console=console)
    trained = json.loads((run / "training.json").read_text())
    return {
        "recipe": contender.name,
        "psnr": metrics["mean"]["psnr"],
        "ssim": metrics["mean"]["ssim"],
        "train psnr": metrics["train_views"]["mean"]["psnr"],
        "input psnr": metrics["train_views"]["input"]["mean"].get("psnr"),
        "steps": trained["steps"],
        "seconds": trained["seconds"],
        "peak MB": trained["peak_memory_mb"],
    }


if __name__ == "__main__":
    main()
