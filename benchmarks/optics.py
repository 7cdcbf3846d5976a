"""`ev-splat` behind lenses with distortion and rolling shutters, beside an ideal camera.

    python -m benchmarks.optics [--steps 500] [--size 160x104] [--only brown rolling ...]

All record the same scene along the same path. `pinhole` sees about as much as `brown`, and `wide`
as much as `fisheye`. `rolling` reads a frame within 25 ms; `rolling, ignored` is the same capture
with the readout left out of its description. Scores are those of held-out frames as recorded.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from benchmarks.table import Row, save, show
from sharpfield.captures.native import layout as native
from sharpfield.cli.arguments import parse_size
from sharpfield.core.capture import Capture
from sharpfield.recipes.settings.presets import prepared
from sharpfield.runs.config import RunConfig
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.simulation.sensors.frames import FrameSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.training.options import TrainingOptions


@dataclass(frozen=True)
class Optics:
    """A camera."""

    focal_of_width: float = 0.92
    lens: str = "pinhole"
    distortion: tuple[float, ...] = ()
    readout_us: float = 0.0
    ignored: bool = False
    """The capture says nothing of its readout."""


CAMERAS = {
    "pinhole": Optics(),
    "brown": Optics(lens="brown", distortion=(-0.3, 0.08, 0.001, -0.001, 0.0)),
    "wide": Optics(0.6),
    "fisheye": Optics(0.6, "fisheye", (-0.02, 0.005, 0.0, 0.0)),
    "rolling": Optics(readout_us=25_000),
    "rolling, ignored": Optics(readout_us=25_000, ignored=True),
}


def recorded(optics: Optics, size: tuple[int, int], seed: int) -> Capture:
    """What the camera records of the garden from a shaky hand."""
    rig = Rig(
        size,
        FrameSensor(row_delay_us=optics.readout_us / (size[1] - 1)),
        focal_of_width=optics.focal_of_width,
        lens=optics.lens,
        distortion=optics.distortion,
    )
    capture = simulate("garden", "shaky", rig=rig, timing=Timing(), seed=seed)
    if not optics.ignored:
        return capture
    frames = capture.needed_frames
    exposure = replace(frames.exposure, row_delay_us=0.0)
    return replace(capture, frames=replace(frames, exposure=exposure))


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--size", default="160x104")
    parser.add_argument("--out", type=Path, default=Path("runs/optics"))
    parser.add_argument("--only", nargs="*", default=list(CAMERAS))
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    rows: list[Row] = []
    for name in asked.only:
        capture = recorded(CAMERAS[name], parse_size(asked.size), asked.seed)
        run, source = (asked.out / name.replace(", ", "-") / part for part in ("run", "capture"))
        native.write(capture, source)
        recipe = prepared("ev-splat", "draft", capture=capture, device="cpu")
        started = RunConfig("ev-splat", recipe, str(source.resolve()), asked.seed)
        options = TrainingOptions(steps=asked.steps)
        train_run(started, capture, run, options, device="cpu", console=Console())
        mean = open_run(run, capture=None, device="cpu").evaluate(console=Console())["mean"]
        rows.append({"camera": name, "psnr": mean["psnr"], "ssim": mean["ssim"]})
        save("optics", rows, {"steps": str(asked.steps), "size": asked.size})
    show(rows)


if __name__ == "__main__":
    main()
