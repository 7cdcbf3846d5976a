"""The command that trains a long capture in blocks: here, or shared out by torchrun."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tyro.conf import Positional

from sharpfield.captures.blocks import blocks_of
from sharpfield.captures.layout import NO_OPTIONS, ReadOptions
from sharpfield.captures.read import read_capture
from sharpfield.cli.arguments import Device, screen
from sharpfield.cli.recipe_options import hint_at_flags
from sharpfield.cli.train import TRAINING, Selection
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.recipes.settings.options import changed, with_options
from sharpfield.recipes.settings.presets import prepared
from sharpfield.recipes.splats.merge import merge
from sharpfield.runs.config import (
    RunConfig,
    device_named,
    read_run_config,
    write_run_config,
)
from sharpfield.runs.run import open_run
from sharpfield.runs.start import start
from sharpfield.training.checkpoint import Progress, check_settings, file_of, save_last
from sharpfield.training.optim import adam
from sharpfield.training.options import Options
from sharpfield.training.record import Ledger, read_ledger, write_ledger

FOLDER = "blocks"
"""Of the runs of the blocks, in the run they make together."""


@dataclass(frozen=True)
class BlockSelection(Selection):
    """What of the recipe, and of the capture, is used, and in how many blocks."""

    count: int = 2
    """Blocks that the capture is cut into."""


SELECTION = BlockSelection()


def blocks_command(
    recipe: Positional[str],
    capture: Positional[Path],
    out: Path,
    device: Device = "auto",
    selection: BlockSelection = SELECTION,
    training: Options = TRAINING,
    reading: ReadOptions = NO_OPTIONS,
    numbers: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Train a long capture in overlapping blocks, and merge them into one run.

    The same command goes on where an earlier one stopped. To train blocks side by side, start it by
    torchrun, which restarts workers that die:
    `torchrun --nproc-per-node 2 --max-restarts 3 --no-python sharpfield blocks ...`.

    Args:
        recipe: One of those made of Gaussians, such as room-splat.
        capture: Folder of the capture.
        out: Folder of the merged run; the blocks' own runs are in it.
        device: Where to train.
        selection: Presets, streams, blocks, seed.
        training: How long, how often to save, how much memory; for each block.
        reading: How to read the capture, where its layout is wrong or silent.
        numbers: Options of the recipe by name, such as sampling.views.
    """
    if selection.block:
        raise OptionError("blocks are trained one and all", got=selection.block, do="use `train`")
    hint_at_flags(recipe, selection.change)
    console, where, count = screen(), device_named(device), selection.count
    source = read_capture(capture, reading)
    made = prepared(recipe, selection.preset, capture=source, device=where)
    made = with_options(changed(made, selection.change), numbers)
    whole = RunConfig(recipe, made, str(capture.resolve()), selection.seed, selection.use, reading)
    runs = [out / FOLDER / f"{i + 1}of{count}" for i in range(count)]
    started = [replace(whole, block=f"{i + 1}/{count}") for i in range(count)]
    for run, block in zip(runs, started, strict=True):
        if read_ledger(run) is not None:  # finished ones are not opened again
            check_settings(read_run_config(run).settings(), block.settings())
    for i in _mine(count, os.environ):
        block, done = started[i], read_ledger(runs[i])
        if done is not None and done.finished:
            continue
        console.print(f"Block {block.block}")
        going_on = replace(training, resume=training.resume or done is not None)
        start(block, source, runs[i], going_on, device=where, console=console)
    ledgers = [ledger for run in runs if (ledger := read_ledger(run)) is not None]
    if len(ledgers) == count and all(ledger.finished for ledger in ledgers):
        together = _together(ledgers)
        if not _up_to_date(whole, together, out, runs):
            _merge(whole, source, out, runs, together)
        console.print(f"Merged. `sharpfield evaluate {out}` measures it.")


def _mine(count: int, environment: Mapping[str, str]) -> range:
    """The blocks of this process, as torchrun numbers processes; all if it did not start it."""
    rank, world = int(environment.get("RANK", 0)), int(environment.get("WORLD_SIZE", 1))
    return range(rank, count, world)


def _together(ledgers: list[Ledger]) -> Ledger:
    """What all blocks cost."""
    steps = max(ledger.planned_steps for ledger in ledgers)
    return Ledger(
        planned_steps=steps,
        parts=1,
        device=ledgers[0].device,
        steps=steps,
        seconds=sum(ledger.seconds for ledger in ledgers),
        peak_memory_mb=max(ledger.peak_memory_mb for ledger in ledgers),
    )


def _up_to_date(whole: RunConfig, together: Ledger, out: Path, runs: list[Path]) -> bool:
    """Whether the merged run was made of these blocks, as they are now."""
    if read_ledger(out) != together:  # written last
        return False
    check_settings(read_run_config(out).settings(), whole.settings())
    merged, *blocks = (file_of(run, "last").stat().st_mtime_ns for run in (out, *runs))
    return all(block <= merged for block in blocks)


def _merge(
    whole: RunConfig, source: Capture, out: Path, runs: list[Path], together: Ledger
) -> None:
    """Write the merged run: what all workers that get here write is the same."""
    models = [open_run(run, device="cpu").model for run in runs]
    merged: Any = merge(models, blocks_of(source, len(runs)))
    write_run_config(out, whole)
    progress = Progress(together.steps, together.steps, settings=whole.settings())
    save_last(out, merged, adam(merged), progress)
    write_ledger(out, together)
