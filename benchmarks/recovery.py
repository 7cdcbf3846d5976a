"""What a camera does not tell, found again: thresholds, poses and the clocks' offset.

    python -m benchmarks.recovery [--minutes 6 | --steps 4000] [--size 160x104]
        [--thresholds 0.23 0.31] [--seed 0] [--only refined] [--out runs/recovery]

A simulated camera has thresholds of 0.23 and 0.31; `ev-splat` starts from 0.25 for both, from poses
that are off by 0.4 degrees and 1 % of the scene's depth (smoothly, as those of an encoder or of
structure from motion), and from events that are 2 ms late. The capture is written to disk and
trained by the same code as the command line's, with the preset `refine`.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from benchmarks.table import save, show
from sharpfield.captures.native import layout as native
from sharpfield.cli.arguments import parse_size
from sharpfield.core.capture import Capture
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped
from sharpfield.recipes.settings.presets import prepared
from sharpfield.runs.config import RunConfig
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.training.options import TrainingOptions

THRESHOLDS, GUESS = (0.23, 0.31), (0.25, 0.25)
LATE_US = 2000
OFF_DEG, OFF_OF_DEPTH = 0.4, 0.01
WAVES = 5
"""The error of the poses has this many half waves along the recording, and fewer."""


def recorded(size: tuple[int, int], thresholds: tuple[float, float], seed: int) -> Capture:
    """A capture with everything known, free of noise."""
    darker, brighter = thresholds
    sensor = EventSensor(threshold_off=darker, threshold_on=brighter)
    timing = Timing(frames=26, exposure_us=50_000, interval_us=56_000)
    return simulate("garden", "shaky", rig=Rig(size, event_sensor=sensor), timing=timing, seed=seed)


def spoiled(truth: Capture, seed: int) -> Capture:
    """The same capture as a user would have it."""
    path, events = truth.trajectory, truth.needed_events
    assert isinstance(path, Stamped)
    random = np.random.default_rng(seed)
    part = (path.times_us - path.times_us[0]) / np.ptp(path.times_us)
    waves = np.cos(np.pi * np.arange(1, WAVES + 1) * part[:, None])
    error = waves @ random.normal(size=(WAVES, 6))
    error -= error.mean(0)
    depth = np.sqrt(truth.near * truth.far)
    for axes, most in ((slice(0, 3), np.deg2rad(OFF_DEG)), (slice(3, 6), OFF_OF_DEPTH * depth)):
        length = np.sqrt((error[:, axes] ** 2).sum(-1).mean())
        error[:, axes] *= most / length
    poses = se3.compose(torch.from_numpy(path.poses), se3.exp(torch.from_numpy(error))).numpy()
    return replace(
        truth,
        trajectory=Stamped(path.times_us, poses, truth.clock),
        events=replace(events, t_us=events.t_us + LATE_US),
        known=replace(truth.known, thresholds=None),
        name="spoiled",
    )


def pose_error(capture: Capture, truth: Capture) -> tuple[float, float]:
    """Root mean square errors at the frames' middles after the best similarity.

    In degrees, and in percent of the scene's depth. The turn of the similarity is taken from where
    the cameras look, not from where they are: a hand that shakes does not go far.
    """
    every = np.arange(len(truth.needed_frames))
    found, known = (c.frame_pose(every).detach().double() for c in (capture, truth))
    u, _, vt = torch.linalg.svd((known[..., :3] @ found[..., :3].mT).sum(0))
    turn = u @ vt
    centre = found[..., 3] @ turn.T
    centre, goal = centre - centre.mean(0), known[..., 3] - known[..., 3].mean(0)
    scale = (centre * goal).sum() / centre.square().sum()
    off = (known[..., :3].mT @ turn @ found[..., :3]).diagonal(dim1=-2, dim2=-1).sum(-1)
    degrees = torch.rad2deg(torch.acos(((off - 1) / 2).clamp(-1, 1))).square().mean().sqrt()
    away = (scale * centre - goal).square().sum(-1).mean().sqrt()
    return float(degrees), 100 * float(away) / float(np.sqrt(truth.near * truth.far))


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--steps", type=int, help="instead of minutes")
    parser.add_argument("--thresholds", type=float, nargs=2, default=THRESHOLDS)
    parser.add_argument("--size", default="160x104")
    parser.add_argument("--out", type=Path, default=Path("runs/recovery"))
    parser.add_argument("--only", nargs="*", default=["believed", "refined"])
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    console = Console()
    thresholds = asked.thresholds[0], asked.thresholds[1]
    options = TrainingOptions(steps=asked.steps, minutes=None if asked.steps else asked.minutes)
    truth = recorded(parse_size(asked.size), thresholds, asked.seed)
    capture = spoiled(truth, asked.seed + 1)
    native.write(truth, asked.out / "truth")
    native.write(capture, asked.out / "capture")
    rows = []
    presets = {"believed": "draft", "refined": "refine,draft"}
    for name, preset in ((name, presets[name]) for name in asked.only):
        run = asked.out / name
        recipe = prepared("ev-splat", preset, capture=capture, device="cpu")
        recipe = replace(recipe, calibration=replace(recipe.calibration, threshold=GUESS))
        started = RunConfig("ev-splat", recipe, str((asked.out / "capture").resolve()), asked.seed)
        train_run(started, capture, run, options, device="cpu", console=console)
        opened = open_run(run, capture=None, device="cpu")
        metrics = opened.evaluate(console=console)
        rows.append({"poses": name, **_row(opened.model, metrics, truth, thresholds)})
    show(rows)
    length = f"{asked.steps} steps" if asked.steps else f"{asked.minutes} minutes"
    facts = {"length": length, "size": asked.size, "thresholds": str(thresholds)}
    print(save("recovery", rows, facts | {"seed": str(asked.seed)}))


def _row(
    model: Any, metrics: dict[str, Any], truth: Capture, thresholds: tuple[float, float]
) -> dict[str, Any]:
    darker, brighter = model.calibration.threshold_pair()
    degrees, percent = pose_error(model.capture, truth)
    return {
        "darker": darker,
        "off %": 100 * (darker / thresholds[0] - 1),
        "brighter": brighter,
        "off % ": 100 * (brighter / thresholds[1] - 1),
        "late us": model.calibration.offset_us,
        "pose deg": degrees,
        "pose % depth": percent,
        "psnr": metrics["mean"]["psnr"],
        "ssim": metrics["mean"]["ssim"],
    }


if __name__ == "__main__":
    main()
