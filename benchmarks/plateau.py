"""How long a recipe has to train until longer training gains nothing more.

    python -m benchmarks.plateau [ev-splat | evdnerf-physical] [--device cuda] [--size 600x400]

The recipe is trained anew with twice the time each round, each with a schedule of its own, until
a round gains less than `--gain` dB on held-out views. `ev-splat` learns *garden* from 26 blurry
frames of a shaky camera; `evdnerf-physical` *glider* from 18 still cameras in a ring, events alone.
"""

import argparse
import json
from collections.abc import Callable
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
from sharpfield.simulation.cameras.rigs import ring
from sharpfield.simulation.moving_capture import MOVING_RIG, simulate_moving
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.training.options import TrainingOptions

Size = tuple[int, int]


def shaken(size: Size, seed: int) -> Capture:
    """Blurry frames and events of a scene that stands still."""
    timing = Timing(frames=30, exposure_us=60_000, interval_us=66_000)
    return simulate("garden", "shaky", rig=Rig(size), timing=timing, seed=seed)


def ringed(size: Size, seed: int) -> Capture:
    """Events of a scene that moves, from 18 sides; two more cameras are held out."""
    rig = replace(MOVING_RIG, size=size)
    return simulate_moving("glider", ring(18, held_out=2), rig=rig, seed=seed)


@dataclass(frozen=True)
class Race:
    """What is trained, on what, and what is compared."""

    size: str
    """Of the published captures."""
    capture: Callable[[Size, int], Capture]
    use: tuple[str, ...]
    score: str
    """Of `metrics.json`."""


RACES = {
    "ev-splat": Race("600x400", shaken, ("frames", "events"), "psnr"),
    "evdnerf-physical": Race("128x128", ringed, ("events",), "psnr_aligned"),
}


def round_of(name: str, minutes: float, capture: Path, run: Path, device: str) -> Row:
    """Train for a time and score the result."""
    race, console, seen = RACES[name], Console(), native.read(capture)
    recipe = prepared(name, "draft", capture=seen, device=device)
    started = RunConfig(name, recipe, str(capture.resolve()), 0, use=race.use)
    train_run(started, seen, run, TrainingOptions(minutes=minutes), device=device, console=console)
    mean = open_run(run, device=device).evaluate(console=console)["mean"]
    trained = json.loads((run / "training.json").read_text())
    return {
        "minutes": minutes,
        "seconds": trained["seconds"],
        "steps": trained["steps"],
        race.score: mean[race.score],
        "peak MB": trained["peak_memory_mb"],
    }


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recipe", nargs="?", choices=RACES, default="ev-splat")
    parser.add_argument("--size", help="pixels; by default those of the published captures")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--first", type=float, default=0.5, help="minutes of the first round")
    parser.add_argument("--most", type=float, default=16.0, help="minutes of the longest round")
    parser.add_argument("--gain", type=float, default=0.2, help="dB that a plateau gains at most")
    parser.add_argument("--out", type=Path, default=Path("runs/plateau"))
    asked = parser.parse_args()
    race = RACES[asked.recipe]
    size = parse_size(asked.size or race.size)
    out = asked.out / f"{asked.recipe}-{size[0]}x{size[1]}"
    native.write(race.capture(size, 0), out / "capture")
    rows: list[Row] = []
    minutes = asked.first
    while minutes <= asked.most:
        run = out / f"{minutes:g}min"
        rows.append(round_of(asked.recipe, minutes, out / "capture", run, asked.device))
        if len(rows) > 1 and rows[-1][race.score] < rows[-2][race.score] + asked.gain:
            break
        minutes *= 2
    show(rows)
    facts = {"recipe": asked.recipe, "size": "{}x{}".format(*size), "device": asked.device}
    print(save(f"plateau_{asked.recipe}_{asked.device}", rows, facts))


if __name__ == "__main__":
    main()
