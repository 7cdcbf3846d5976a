"""Starting a run, or going on with one: a recipe trained on a capture, in a folder."""

from pathlib import Path
from typing import Any

from rich.console import Console

from sharpfield.captures.native.layout import read, write
from sharpfield.core.capture import Capture
from sharpfield.core.errors import RunError
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
            write(given, own)
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
