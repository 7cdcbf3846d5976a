"""`sharpfield train`: train a recipe on a capture.

`sharpfield blocks`: train a long capture in blocks, in one process or under torchrun.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import Positional

from sharpfield.captures.layout import NO_OPTIONS, ReadOptions
from sharpfield.cli.arguments import Device, screen
from sharpfield.cli.recipe_options import hint_at_flags
from sharpfield.core.errors import OptionError
from sharpfield.training.options import TrainingOptions

if TYPE_CHECKING:
    from sharpfield.core.capture import Capture
    from sharpfield.runs.config import RunConfig


@dataclass(frozen=True)
class Selection:
    """Presets of the recipe, and the part of the capture to train on."""

    preset: str = ""
    """Names of presets, separated by commas; `sharpfield recipes describe RECIPE` lists them. By
    default they follow the capture and the device."""
    use: tuple[str, ...] = ("frames", "events")
    """Streams of the capture to train on."""
    block: str = ""
    """Block of a long capture, 2/4 for the second of four; see `sharpfield blocks`."""
    seed: int = 0
    """Random seed."""
    change: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Options of the recipe, as events.weight=0; better written --events.weight 0."""


SELECTION, TRAINING = Selection(), TrainingOptions()


def train_command(
    recipe: Positional[str],
    capture: Positional[Path],
    out: Path,
    device: Device = "auto",
    selection: Selection = SELECTION,
    training: TrainingOptions = TRAINING,
    reading: ReadOptions = NO_OPTIONS,
    numbers: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Train a recipe on a capture. `sharpfield train RECIPE --help` lists the options of a recipe.

    Args:
        recipe: Name of the recipe; `sharpfield recipes` lists them.
        capture: Folder of the capture.
        out: Folder of the run, which must be new unless you resume.
        device: Device to train on.
        selection: Presets, streams, block, seed.
        training: How long, how often to save, how much memory.
        reading: How to read the capture, where its layout is wrong or silent.
        numbers: Options of the recipe by name, such as sampling.views.
    """
    from sharpfield.runs.config import device_named
    from sharpfield.runs.start import train_run

    console, where = screen(), device_named(device)
    started, source = _configured(recipe, capture, where, selection, reading, numbers)
    trained = train_run(started, source, out, training, device=where, console=console)
    if trained.status.finished:
        console.print(f"Done. `sharpfield evaluate {out}` measures it.")


def _configured(
    recipe: str,
    capture: Path,
    device: str,
    selection: Selection,
    reading: ReadOptions,
    numbers: Mapping[str, Any],
) -> tuple["RunConfig", "Capture"]:
    """The run that was asked for, and the capture it is trained on."""
    from sharpfield.captures.read import read_capture
    from sharpfield.recipes.settings.options import changed, with_options
    from sharpfield.recipes.settings.presets import prepared
    from sharpfield.runs.config import RunConfig

    hint_at_flags(recipe, selection.change)
    source = read_capture(capture, reading)
    made = prepared(recipe, selection.preset, capture=source, device=device)
    made = with_options(changed(made, selection.change), numbers)
    folder, part = str(capture.resolve()), selection.block
    config = RunConfig(recipe, made, folder, selection.seed, selection.use, reading, part)
    return config, source


@dataclass(frozen=True)
class BlockSelection(Selection):
    """Presets of the recipe, the streams to train on, and the number of blocks."""

    count: int = 2
    """Number of blocks that the capture is divided into."""


BLOCK_SELECTION = BlockSelection()


def blocks_command(
    recipe: Positional[str],
    capture: Positional[Path],
    out: Path,
    device: Device = "auto",
    selection: BlockSelection = BLOCK_SELECTION,
    training: TrainingOptions = TRAINING,
    reading: ReadOptions = NO_OPTIONS,
    numbers: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Train a long capture in overlapping blocks, and merge them into one run.

    The same command continues where an earlier one stopped. To train blocks in parallel, start it
    with torchrun, which restarts workers that die:
    `torchrun --nproc-per-node 2 --max-restarts 3 --no-python sharpfield blocks ...`.

    Args:
        recipe: Name of a recipe on Gaussians, such as room-splat.
        capture: Folder of the capture.
        out: Folder of the merged run; the blocks' own runs are in it.
        device: Device to train on.
        selection: Presets, streams, blocks, seed.
        training: How long, how often to save, how much memory; for each block.
        reading: How to read the capture, where its layout is wrong or silent.
        numbers: Options of the recipe by name, such as sampling.views.
    """
    from sharpfield.runs.blocks import BlockRuns, train_blocks
    from sharpfield.runs.config import device_named

    if selection.block:
        raise OptionError("blocks are trained one and all", got=selection.block, do="use `train`")
    console, where = screen(), device_named(device)
    whole, source = _configured(recipe, capture, where, selection, reading, numbers)
    merged = train_blocks(
        BlockRuns(whole, out, selection.count),
        source,
        training,
        own=_mine(selection.count, os.environ),
        device=where,
        console=console,
    )
    if merged:
        console.print(f"Merged. `sharpfield evaluate {out}` measures it.")


def _mine(count: int, environment: Mapping[str, str]) -> range:
    """The blocks of this process, as torchrun numbers processes; all if it did not start it."""
    rank, world = int(environment.get("RANK", 0)), int(environment.get("WORLD_SIZE", 1))
    return range(rank, count, world)
