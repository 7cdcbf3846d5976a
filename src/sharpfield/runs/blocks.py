"""A long capture trained in overlapping blocks, each a run of its own, merged into one run."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from sharpfield.captures.splits import blocks_of
from sharpfield.core.capture import Capture
from sharpfield.recipes.splats.model import merge_blocks
from sharpfield.runs.config import RunConfig, read_run_config, write_run_config
from sharpfield.runs.run import open_run
from sharpfield.runs.start import train_run
from sharpfield.training.checkpoint import TrainingProgress, check_settings, file_of, save_last
from sharpfield.training.optim import adam
from sharpfield.training.options import TrainingOptions
from sharpfield.training.status import TrainingStatus, read_status, write_status

FOLDER = "blocks"
"""Folder of the runs of blocks, within the run they are merged into."""


@dataclass(frozen=True)
class BlockRuns:
    """The runs of all blocks of a capture, and the one they are merged into."""

    whole: RunConfig
    """Of the merged run."""
    out: Path
    """Folder of the merged run."""
    count: int
    """How many blocks there are."""

    def configs(self) -> list[RunConfig]:
        """Of each block."""
        return [replace(self.whole, block=f"{i + 1}/{self.count}") for i in range(self.count)]

    def folders(self) -> list[Path]:
        """Of each block."""
        return [self.out / FOLDER / f"{i + 1}of{self.count}" for i in range(self.count)]


def train_blocks(
    runs: BlockRuns,
    capture: Capture,
    options: TrainingOptions,
    *,
    own: Iterable[int] | None = None,
    device: str,
    console: Console | None = None,
) -> bool:
    """Train the blocks that are not finished, and merge all once they are.

    Args:
        runs: Which blocks, and where.
        capture: As read, all of it.
        options: How long, how often to save, how much memory; for each block.
        own: Blocks to train here, counted from 0, where others train elsewhere at the same time.
        device: `cpu` or `cuda`.
        console: Where progress is shown.

    Returns:
        Whether all blocks are finished, and merged.

    Raises:
        RunError: A block was begun with other options, or a loss is not finite.
    """
    console, folders, configs = console or Console(), runs.folders(), runs.configs()
    for folder, block in zip(folders, configs, strict=True):
        if read_status(folder) is not None:  # finished ones are not opened again
            check_settings(read_run_config(folder).settings(), block.settings())
    for i in range(runs.count) if own is None else own:
        block, done = configs[i], read_status(folders[i])
        if done is not None and done.finished:
            continue
        console.print(f"Block {block.block}")
        going_on = replace(options, resume=options.resume or done is not None)
        train_run(block, capture, folders[i], going_on, device=device, console=console)
    statuses = [status for folder in folders if (status := read_status(folder)) is not None]
    if len(statuses) < runs.count or not all(status.finished for status in statuses):
        return False
    together = _together(statuses)
    if not _up_to_date(runs, together):
        _merge(runs, capture, together)
    return True


def _together(statuses: list[TrainingStatus]) -> TrainingStatus:
    """What all blocks cost."""
    steps = max(status.planned_steps for status in statuses)
    return TrainingStatus(
        planned_steps=steps,
        micro_batches=1,
        device=statuses[0].device,
        steps=steps,
        seconds=sum(status.seconds for status in statuses),
        peak_memory_mb=max(status.peak_memory_mb for status in statuses),
    )


def _up_to_date(runs: BlockRuns, together: TrainingStatus) -> bool:
    """Whether the merged run was made of these blocks, as they are now."""
    if read_status(runs.out) != together:  # written last
        return False
    check_settings(read_run_config(runs.out).settings(), runs.whole.settings())
    checkpoints = [file_of(run, "last").stat().st_mtime_ns for run in (runs.out, *runs.folders())]
    return all(block <= checkpoints[0] for block in checkpoints[1:])


def _merge(runs: BlockRuns, capture: Capture, together: TrainingStatus) -> None:
    """Write the merged run: what all processes that get here write is the same."""
    models = [open_run(run, device="cpu").model for run in runs.folders()]
    merged: Any = merge_blocks(models, blocks_of(capture, runs.count))
    write_run_config(runs.out, runs.whole)
    progress = TrainingProgress(together.steps, together.steps, settings=runs.whole.settings())
    save_last(runs.out, merged, adam(merged), progress)
    write_status(runs.out, together)
