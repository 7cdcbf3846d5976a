"""Starting a run, or resuming one; captures written in the layouts that other programs read."""

from importlib import import_module
from pathlib import Path
from typing import Any

from rich.console import Console

from sharpfield.captures.native.layout import read
from sharpfield.captures.native.layout import write as write_native
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError, RunError, expect_one_of
from sharpfield.core.events import checked
from sharpfield.core.protocols import Model
from sharpfield.evaluation.views import validation
from sharpfield.runs.config import OWN_CAPTURE, RunConfig, block_of, used, write_run_config
from sharpfield.runs.run import Run
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import require_unused, train


def train_run(
    config: RunConfig,
    capture: Capture,
    folder: Path,
    options: TrainingOptions,
    *,
    device: str,
    console: Console | None = None,
) -> Run:
    """Train a recipe on a capture in a run's folder, or go on with it.

    Args:
        config: Recipe, seed, and which part of the capture. A relative `capture` means one that
            exists only in memory: it is written into the run, so that the run can be opened again.
        capture: As read, all of it.
        folder: Of the run.
        options: How long, how often to save, how much memory.
        device: `cpu` or `cuda`.
        console: Where progress is shown.

    Raises:
        RunError: The folder holds another run, or one on another capture; or a loss is not finite.
    """
    if not options.resume:
        require_unused(folder)
        write_run_config(folder, config)
    if config.capture == OWN_CAPTURE:
        given, own = capture, folder / OWN_CAPTURE
        if not options.resume or not own.exists():
            write_native(given, own)
        capture = read(own)  # what will be read when the run is opened again
        if repr(capture) != repr(given):  # counts, sizes and spans of frames and events
            raise RunError(
                "the run was started with another capture",
                where=own,
                got=repr(given),
                do="resume with the same capture, or train into another folder",
            )
    part = block_of(capture, config.block)
    chosen = used(part, config.use)
    built: list[Any] = []

    def build(steps: int) -> Model:
        built[:] = []  # a model that was only for measuring time makes room
        model = config.recipe.lasting(steps).build(chosen, config.seed).to(device)
        built.append(model)
        return model

    train(
        build,
        folder,
        options,
        steps=config.recipe.steps,
        settings=config.settings(),
        validate=validation(part),
        console=console,
    )
    return Run(folder, config, built[-1], part)


WRITERS: dict[str, str] = {
    "native": "native.layout",
    "ev-deblur-nerf": "writers.llff_events",
    "evdnerf": "writers.evdnerf",
    "scannet": "writers.scannet",
}
"""Modules in `sharpfield.captures`, each with a function `write`."""


def write(capture: Capture, folder: Path | str, layout: str = "native") -> None:
    """Write a capture; the folder appears whole or not at all. An earlier capture is replaced.

    Args:
        capture: To be written.
        folder: Where.
        layout: native, which keeps everything; ev-deblur-nerf, evdnerf, scannet.

    Raises:
        OptionError: There is no such layout.
        CaptureError: The folder holds something else, or the capture holds something the layout
            has no place for.
    """
    expect_capture(capture)
    expect_one_of("layout to write", layout, WRITERS)
    import_module(f"sharpfield.captures.{WRITERS[layout]}").write(capture, Path(folder))


def expect_capture(capture: object) -> None:
    """Make sure that this is a capture, and that its events are valid; it may be made by hand.

    Raises:
        OptionError: It is something else.
        ShapeError: A column of its events has another type.
        CaptureError: Its events are not valid.
    """
    if not isinstance(capture, Capture):
        raise OptionError(
            "this is not a capture",
            got=type(capture).__name__,
            do="give what sf.read or sf.simulate return; sf.train also takes a folder",
        )
    if capture.events is not None:
        checked(capture.events, capture.name)
