"""What every recipe computes on tiny seeded captures, as numbers that must not change by accident.

`python -m tests.golden.golden` writes `golden.json` anew; do that only when a method is meant to
change, and say so in the notebook.
"""

import csv
import json
import tempfile
from pathlib import Path
from typing import Any

import torch

from tests.cli.command import run
from tests.golden.views import first_view

FILE = Path(__file__).parent / "golden.json"
STEPS = 20

CAPTURES = {
    "still": "--scene tiles --size 24x16 --frames 6 --exposure-us 20000 --interval-us 24000"
    " --test-every 4 --seed 3",
    "moving": "--scene arm --size 16x16 --views 4 --held-out 1 --frames 6 --exposure-us 20000"
    " --interval-us 30000 --seed 3",
    "room": "--scene room --size 24x18 --frames 12 --events --exposure-us 50000"
    " --interval-us 200000 --test-every 4 --seed 3",
}

CASES = [
    ("nerf", "draft", "still"),
    ("ev-deblur-nerf", "physical,draft", "still"),
    ("ev-deblur-nerf", "blender_full,draft", "still"),
    ("ev-deblur-nerf", "blender_minus,draft", "still"),
    ("ev-deblur-nerf", "cdavis_full,draft", "still"),
    ("splat", "draft", "still"),
    ("edi-splat", "draft", "still"),
    ("blur-splat", "draft", "still"),
    ("event-splat", "draft", "still"),
    ("ev-splat", "draft", "still"),
    ("ev-splat", "standard", "still"),
    ("ev-splat", "refine,draft", "still"),
    ("room-splat", "draft", "room"),
    ("room-splat", "refine,draft", "room"),
    ("point-nerf", "draft", "room"),
    ("hybrid", "draft", "room"),
    ("hybrid", "h-only,draft", "room"),
    ("hybrid", "rooms,draft", "room"),
    ("hybrid", "learned,draft", "room"),
    ("hybrid", "no-images,draft", "room"),
    ("d-nerf", "draft", "moving"),
    ("evdnerf", "draft", "moving"),
    ("evdnerf", "lego,draft", "moving"),
    ("evdnerf", "real,draft", "moving"),
    ("evdnerf-physical", "draft", "moving"),
    ("dynamic-splat", "draft", "moving"),
    ("ev-dynamic-splat", "draft", "moving"),
]


def main() -> None:
    """Compute all cases and write them."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        captures, found = simulated(Path(folder)), {}
        for recipe, preset, capture in CASES:
            name = f"{recipe} {preset}"
            out = captures / name.replace(" ", "_")
            found[name] = numbers(recipe, preset, captures / capture, out)
    FILE.write_text(json.dumps(found, indent=1) + "\n")


def simulated(folder: Path) -> Path:
    """A folder with the captures in it."""
    for name, words in CAPTURES.items():
        assert run("simulate", "--out", folder / name, *words.split()) == 0
    return folder


def numbers(recipe: str, preset: str, capture: Path, out: Path) -> dict[str, Any]:
    """Losses, parameters, a view and scores of a run of a few steps."""
    words = ("--preset", preset, "--steps", STEPS, "--log-every", 1, "--device", "cpu")
    assert run("train", recipe, capture, "--out", out, *words, "--validate-every", 1000) == 0
    assert run("evaluate", out, "--device", "cpu") == 0
    with (out / "log.csv").open() as file:
        losses = [float(row["total"]) for row in csv.DictReader(file) if row["total"]]
    count, view = first_view(out)
    mean = json.loads((out / "metrics.json").read_text())["mean"]
    mean.pop("seconds_per_view", None)
    return {
        "losses": losses,
        "parameters": count,
        "view": [
            view.mean().item(),
            view.std().item(),
            *view.flatten()[:: view.numel() // 16].tolist(),
        ],
        "metrics": {name: value for name, value in mean.items() if value is not None},
    }


if __name__ == "__main__":
    main()
