"""Recipes for rooms on one walk, with the same time each; and the studies of the hybrid's paper.

    python -m benchmarks.rooms [--study recipes|weights|capacity|points] [--minutes 6]

Without a capture (`--capture FOLDER`) the room is simulated: 120 frames of 240x180, 75 % blurred.
`weights` compares frames weighted by quality with frames that all count alike; `capacity` gives the
networks more points and wider descriptors; `points` takes fewer and noisier ones. With
`--steps 800` instead of minutes it comes out the same on a busy machine.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from benchmarks.table import Row, save, show
from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_capture
from sharpfield.cli.arguments import parse_size
from sharpfield.core.capture import Capture
from sharpfield.recipes.settings.options import changed
from sharpfield.recipes.settings.presets import prepared
from sharpfield.runs.config import RunConfig
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.simulation.room_capture import ROOM_RIG, RoomTiming, simulate_room
from sharpfield.training.options import TrainingOptions


@dataclass(frozen=True)
class Contender:
    """A recipe with some of its numbers changed."""

    recipe: str
    preset: str = "draft"
    changes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """In the table."""
        return " ".join([self.recipe, *([self.preset] if self.preset != "draft" else [])])


H = "h-only,draft"
MORE, WIDER = "cloud.max_points=200000", "sizes.channels=32"
FEW, NOISY = "cloud.max_points=10000", "cloud.noise=0.05"

STUDIES = {
    "recipes": (
        Contender("point-nerf"),
        Contender("hybrid", H),
        Contender("hybrid"),
        Contender("splat"),
        Contender("room-splat"),
    ),
    "weights": (
        Contender("hybrid"),
        Contender("hybrid", changes=("frame_quality=even",)),
        Contender("room-splat"),
        Contender("room-splat", changes=("sampling.frame_quality=even",)),
    ),
    "capacity": (
        Contender("point-nerf"),
        Contender("point-nerf", changes=(MORE,)),
        Contender("point-nerf", changes=(WIDER,)),
        Contender("hybrid", H),
    ),
    "points": tuple(
        Contender(recipe, preset, changes)
        for changes in ((), (FEW,), (NOISY,))
        for recipe, preset in (("point-nerf", "draft"), ("hybrid", H))
    ),
}


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--study", choices=STUDIES, default="recipes")
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--size", default="240x180")
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--steps", type=int, help="instead of minutes: the same on any machine")
    parser.add_argument("--out", type=Path, default=Path("runs/rooms"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    out = asked.out / asked.study
    source = asked.capture or out / "capture"
    if not source.exists():
        rig = replace(ROOM_RIG, size=parse_size(asked.size))
        timing = replace(RoomTiming(), frames=asked.frames)
        native.write(simulate_room(rig=rig, timing=timing, seed=asked.seed), source)
    capture, rows = read_capture(source), []
    budget = f"{asked.steps} steps" if asked.steps else f"{asked.minutes:g} minutes"
    for number, contender in enumerate(STUDIES[asked.study]):
        rows.append(_compete(contender, capture, source, out / f"{number}", asked))
        facts = {"capture": capture.name, "budget": budget, "seed": asked.seed}
        print(save(f"rooms_{asked.study}", rows, {k: str(v) for k, v in facts.items()}))
    show(rows)


def _compete(
    contender: Contender, capture: Capture, source: Path, run: Path, asked: argparse.Namespace
) -> Row:
    console, name = Console(), contender.recipe
    recipe = prepared(name, contender.preset, capture=capture, device=asked.device)
    recipe = changed(recipe, contender.changes)
    started = RunConfig(name, recipe, str(source.resolve()), asked.seed)
    options = (
        TrainingOptions(steps=asked.steps)
        if asked.steps
        else TrainingOptions(minutes=asked.minutes)
    )
    train_run(started, capture, run, options, device=asked.device, console=console)
    opened = open_run(run, device=asked.device)
    metrics = opened.evaluate(train_views=1, console=console)
    trained = json.loads((run / "training.json").read_text())
    return {
        "recipe": contender.name,
        "changed": " ".join(contender.changes),
        "psnr": metrics["mean"]["psnr"],
        "ssim": metrics["mean"]["ssim"],
        "steps": trained["steps"],
        "seconds": trained["seconds"],
        "peak MB": trained["peak_memory_mb"],
    }


if __name__ == "__main__":
    main()
