"""Logs of training: `log.csv`, TensorBoard if installed, and a line or a bar on the console.

`log.csv` has one row per logged step: `step` (steps done), `seconds` (spent so far), `total`, then
one column per loss term and per score, empty where there was none. A term that first appears later
adds a column; scores have rows of their own.
"""

import csv
import importlib.util
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor
from torch.optim import Optimizer

from sharpfield.core.files import replacing
from sharpfield.core.protocols import Model
from sharpfield.training.memory import Losses

LINE_SECONDS = 10.0
"""Seconds between lines where the output is a file or a pipe."""

FIRST_COLUMNS = ["step", "seconds", "total"]


class CsvTable:
    """A CSV file that grows by rows, and by columns when a new name appears."""

    def __init__(self, path: Path, *, keep_to: int) -> None:
        """Open `path`; rows after step `keep_to`, whose steps were lost, are dropped."""
        self.path = path
        self.columns = list(FIRST_COLUMNS)
        rows = []
        if path.exists():
            with path.open(newline="") as file:
                reader = csv.DictReader(file)
                rows = [row for row in reader if _is_whole(row) and int(row["step"]) <= keep_to]
                self.columns = list(reader.fieldnames or FIRST_COLUMNS)
        self._rewrite(rows)

    def append(self, row: Mapping[str, float | int]) -> None:
        """Add a row and write it to disk."""
        new = [name for name in row if name not in self.columns]
        if new:
            with self.path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            self.columns += new
            self._rewrite(rows)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self.columns, restval="").writerow(row)

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        with replacing(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.columns, restval="")
            writer.writeheader()
            writer.writerows(rows)


class TrainingLog:
    """Records losses and scores, and shows progress."""

    def __init__(
        self, run: Path, *, begin: int, end: int, seconds: float, console: Console
    ) -> None:
        """Log to a run's folder.

        Args:
            run: The folder.
            begin: Step this session begins with.
            end: Number of steps of the whole run.
            seconds: Training time of earlier sessions.
            console: Where progress is shown.
        """
        self.table = CsvTable(run / "log.csv", keep_to=begin)
        self.board = _tensorboard(run, purge_step=begin)
        self.end, self.console = end, console
        self.begun = time.monotonic() - seconds
        self.bar = Progress(
            TextColumn("{task.completed:>{task.fields[width]}}/{task.total}"),
            BarColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[losses]}"),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self.task = self.bar.add_task(
            "", total=end, completed=begin, width=len(str(end)), speed="", losses=""
        )
        self.last_shown = (begin, time.monotonic())
        self.printed_at = time.monotonic()

    def __enter__(self) -> "TrainingLog":
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()
        if self.board is not None:
            self.board.close()

    @property
    def seconds(self) -> float:
        """Training time of the run so far, over all sessions."""
        return time.monotonic() - self.begun

    def record(self, done: int, values: Mapping[str, float]) -> None:
        """Write values after `done` steps."""
        short = {name: float(f"{value:.6g}") for name, value in values.items()}
        self.table.append({"step": done, "seconds": round(self.seconds, 3), **short})
        if self.board is not None:
            for name, value in values.items():
                self.board.add_scalar(name, value, done)

    def advance(self, done: int) -> None:
        """Advance the progress bar; reads no loss, so it does not wait for the device."""
        self.bar.update(self.task, completed=done)

    def show(self, done: int, values: Mapping[str, float]) -> None:
        """Show the step, the speed and the losses."""
        now = time.monotonic()
        speed = (done - self.last_shown[0]) / max(now - self.last_shown[1], 1e-9)
        self.last_shown = (done, now)
        terms = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        pace = f"{speed:.1f} steps/s" if speed >= 1 else f"{1 / max(speed, 1e-9):.1f} s/step"
        self.bar.update(self.task, speed=pace, losses=terms)
        if not self.console.is_terminal and (
            now - self.printed_at > LINE_SECONDS or done == self.end
        ):
            self.printed_at = now
            left = math.ceil((self.end - done) / max(speed, 1e-9))
            self.print_line(f"step {done}/{self.end}  {pace}  {left} s left  {terms}")

    def print_line(self, line: str) -> None:
        """Print a line, above the progress bar if there is one."""
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)


class LogLosses:
    """A hook that logs the mean of the losses over every `every` steps."""

    def __init__(self, log: TrainingLog, *, every: int) -> None:
        self.log, self.every = log, every
        self.sums: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}

    def __call__(self, step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        """Accumulate the losses on the device; every `every` steps, log their means."""
        self.log.advance(step + 1)
        for name, loss in losses.items():
            self.sums[name] = self.sums[name] + loss if name in self.sums else loss
            self.counts[name] = self.counts.get(name, 0) + 1
        if (step + 1) % self.every and step + 1 != self.log.end:
            return
        sums = torch.stack(list(self.sums.values())).tolist()
        means = {
            name: total / self.counts[name] for name, total in zip(self.sums, sums, strict=True)
        }
        self.sums, self.counts = {}, {}
        values = {"total": sum(means.values()), **means}
        self.log.record(step + 1, values)
        self.log.show(step + 1, values)


def _is_whole(row: Mapping[str | None, Any]) -> bool:
    """Whether a row is complete; a killed process may leave a partial one."""
    return None not in row and None not in row.values() and (row["step"] or "").isdigit()


def _tensorboard(run: Path, *, purge_step: int) -> Any:
    if importlib.util.find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(run / "tensorboard"), purge_step=purge_step)
