"""Commands about runs: train one, measure one, render one."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from rich.progress import track
from tyro.conf import Positional

from sharpfield.captures.layout import NO_OPTIONS, ReadOptions
from sharpfield.captures.read import read_capture
from sharpfield.cli.arguments import Device, screen
from sharpfield.cli.recipe_options import hint_at_flags
from sharpfield.evaluation.paths import camera_path
from sharpfield.evaluation.refine import Refinement
from sharpfield.metrics.lpips import load_lpips
from sharpfield.recipes.settings.options import changed, with_options
from sharpfield.recipes.settings.presets import prepared
from sharpfield.rendering.view import render_view, renderer_of
from sharpfield.report.video import write_video
from sharpfield.runs.config import RunConfig, device_named
from sharpfield.runs.run import open_run
from sharpfield.runs.start import start
from sharpfield.training.plan import Options

EIGHT_BIT = 255


@dataclass(frozen=True)
class Choice:
    """What of the recipe, and of the capture, is used."""

    preset: str = ""
    """Named settings, several with commas between them; `sharpfield recipes describe RECIPE` lists
    them. Left out, they follow the capture and the machine."""
    use: tuple[str, ...] = ("frames", "events")
    """Streams of the capture to learn from."""
    block: str = ""
    """Part of a long capture, 2/4 for the second of four; see `sharpfield blocks`."""
    seed: int = 0
    """Random seed."""
    change: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Options of the recipe, as events.weight=0; better written --events.weight 0."""


CHOICE, OPTIONS, REFINEMENT = Choice(), Options(), Refinement()


def train(
    recipe: Positional[str],
    capture: Positional[Path],
    out: Path,
    device: Device = "auto",
    choice: Choice = CHOICE,
    options: Options = OPTIONS,
    reading: ReadOptions = NO_OPTIONS,
    numbers: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Train a recipe on a capture.

    Args:
        recipe: Its name; `sharpfield recipes` lists them.
        capture: Folder of the capture.
        out: Folder of the run.
        device: Where to train.
        choice: Presets, streams, single numbers.
        options: How long, how often to save, how much memory.
        reading: How to read the capture, where its layout is wrong or silent.
        numbers: Options of the recipe by name, such as sampling.views.
    """
    hint_at_flags(recipe, choice.change)
    console, where = screen(), device_named(device)
    source = read_capture(capture, reading)
    made = prepared(recipe, choice.preset, capture=source, device=where)
    made = with_options(changed(made, choice.change), numbers)
    where_from = str(capture.resolve())
    started = RunConfig(recipe, made, where_from, choice.seed, choice.use, reading, choice.block)
    trained = start(started, source, out, options, device=where, console=console)
    if trained.ledger.finished:
        console.print(f"Done. `sharpfield evaluate {out}` measures it.")


def evaluate(
    run: Positional[Path],
    capture: Path | None = None,
    device: Device = "auto",
    refine: bool = False,
    refinement: Refinement = REFINEMENT,
    train_views: int | None = None,
    lpips_backbone: Path | None = None,
    lpips_linear: Path | None = None,
) -> None:
    """Measure a run on held-out views; write metrics.json and report.html into it.

    Args:
        run: Folder that `train` made.
        capture: Where the capture is, if it moved.
        device: Where to render.
        refine: Refine the held-out poses first, with the scene frozen.
        refinement: How, if so.
        train_views: Most training views to render as well; by default all whose truth is known.
        lpips_backbone: Weights file of torchvision's AlexNet or VGG16, to compute LPIPS.
        lpips_linear: Weights file of LPIPS's own linear layers.
    """
    console = screen()
    opened = open_run(run, capture=capture, device=device)
    lpips = None
    if lpips_backbone is not None and lpips_linear is not None:
        lpips = load_lpips(lpips_backbone, lpips_linear)
    metrics = opened.evaluate(
        refine=refinement if refine else None,
        train_views=train_views,
        lpips=lpips,
        console=console,
    )
    mean = {name: value for name, value in metrics["mean"].items() if value is not None}
    console.print("  ".join(f"{name} {value:.4g}" for name, value in mean.items()))
    console.print(f"The report is {run / 'report.html'}")


def render(
    run: Positional[Path],
    out: Path,
    path: str = "spiral",
    images: int = 60,
    rate: float = 30.0,
    capture: Path | None = None,
    device: Device = "auto",
) -> None:
    """Render a run along a camera path.

    Args:
        run: Folder that `train` made.
        out: A video FILE.mp4, or a folder for PNGs.
        path: spiral, train, or exposure:N for the inside of one exposure.
        images: How many.
        rate: Images per second of a video.
        capture: Where the capture is, if it moved.
        device: Where to render.
    """
    console = screen()
    opened = open_run(run, capture=capture, device=device)
    model = opened.model
    where = device_named(device)
    camera_moves = camera_path(opened.seen, path, images=images)

    def rendered(number: int) -> np.ndarray:
        pose = torch.from_numpy(camera_moves.poses[number]).to(where)
        time = float(camera_moves.time[number])
        seen = render_view(renderer_of(model), model.capture.camera, pose, time)
        return eight_bit(model.encode(seen.rgb))

    numbers = track(
        range(len(camera_moves)), "rendering", console=console, disable=not console.is_terminal
    )
    count = write_video(out, (rendered(number) for number in numbers), rate=rate)
    console.print(f"{count} images are in {out}")


def eight_bit(image: torch.Tensor) -> np.ndarray:
    """Stored values 0...1 as bytes."""
    return (image.clamp(0, 1) * EIGHT_BIT).round().byte().cpu().numpy()
