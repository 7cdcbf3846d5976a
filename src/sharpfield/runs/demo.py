"""The demo: record a scene, rebuild it three ways in the same time, and show the difference."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sharpfield.captures.native import layout as native
from sharpfield.core.capture import Capture
from sharpfield.core.frames import Exposure, Frames
from sharpfield.evaluation.scores import methods_table
from sharpfield.preparation.deblurring import deblur_frames
from sharpfield.preparation.options import DeblurOptions
from sharpfield.recipes.settings.presets import prepared
from sharpfield.report.page import markdown
from sharpfield.runs.config import RunConfig, device_named
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.simulation.sensors.event_pixels import SENSORS
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.training.options import TrainingOptions

STRONG_BLUR = Timing(exposure_us=80_000, interval_us=90_000)
"""Exposures in dim light."""

TITLE = "A sharp scene from blurry frames and events"


@dataclass(frozen=True)
class Contender:
    """One way to rebuild the scene."""

    name: str
    recipe: str
    deblurred: bool
    """Whether it learns from frames that were deblurred first."""
    use: tuple[str, ...]


BASELINES = (
    Contender("nerf", "nerf", deblurred=False, use=("frames",)),
    Contender("edi-nerf", "nerf", deblurred=True, use=("frames",)),
)
OURS = Contender("ev-splat", "ev-splat", deblurred=False, use=("frames", "events"))


def run_demo(
    out: Path, size: tuple[int, int], scene: str, minutes: float, seed: int, *, device: str
) -> None:
    """Record a scene with a shaky camera, rebuild it by three methods, and compare them.

    Args:
        out: Folder of the run; its report.html shows everything.
        size: Sensor resolution of the simulated camera, width and height in px.
        scene: Name of a closed-form scene that stands still.
        minutes: Training time of each of the three methods.
        seed: Random seed of the recording and of training.
        device: auto, cpu or cuda.
    """
    console = Console(highlight=False)
    rig = Rig(size, event_sensor=SENSORS["dvs346"])
    console.print(f"Recording the scene {scene!r} at {size[0]}x{size[1]}")
    capture = replace(simulate(scene, rig=rig, timing=STRONG_BLUR, seed=seed), name=scene)
    native.write(capture, out / "capture")
    sharper = with_deblurred_frames(capture)
    native.write(sharper, out / "capture-edi")

    baselines: dict[str, dict[str, Any]] = {}
    for contender in BASELINES:
        run = out / "baselines" / contender.name
        metrics = _compete(contender, out, run, minutes, seed, device, console)
        baselines[contender.name] = {"mean": metrics["mean"], "run": f"baselines/{contender.name}"}
    metrics = _compete(OURS, out, out, minutes, seed, device, console, baselines=baselines)
    console.print(markdown(methods_table(metrics)))
    console.print(f"\nOpen {out / 'report.html'}")


def with_deblurred_frames(capture: Capture) -> Capture:
    """The capture with its blurry training frames replaced by sharp ones from events (EDI)."""
    made = deblur_frames(capture, DeblurOptions())
    frames = capture.needed_frames
    images = np.array(frames.images)
    images[made.frame] = made.images[:, 0]
    middle = frames.exposure.middle_us
    sharp: Frames = replace(frames, images=images, exposure=Exposure(middle, middle))
    return replace(capture, frames=sharp)


def _compete(
    contender: Contender,
    out: Path,
    run: Path,
    minutes: float,
    seed: int,
    device: str,
    console: Console,
    *,
    baselines: dict[str, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Train and measure one method."""
    console.print(f"Training {contender.name} for {minutes:g} min")
    where = device_named(device)
    source = out / ("capture-edi" if contender.deblurred else "capture")
    capture = native.read(source)
    recipe = prepared(contender.recipe, "draft", capture=capture, device=where)
    started = RunConfig(contender.recipe, recipe, str(source.resolve()), seed, contender.use)
    options = TrainingOptions(minutes=minutes, validate_every=200)
    train_run(started, capture, run, options, device=where, console=console)
    # All are measured against the same capture: blurry input, sharp truth.
    opened = open_run(run, capture=None, device=where)
    opened = replace(opened, capture=native.read(out / "capture"))
    title = TITLE if contender is OURS else f"Baseline: {contender.name}"
    return opened.evaluate(baselines=baselines, title=title, console=console)
