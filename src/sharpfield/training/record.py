"""Writing down how far a run is and what it has cost: its checkpoints and `training.json`."""

import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from torch.optim import Optimizer

from sharpfield.core.device import device_of
from sharpfield.core.errors import RunError
from sharpfield.core.files import write_json
from sharpfield.core.protocols import Model
from sharpfield.training.checkpoint import Progress, save_best, save_last
from sharpfield.training.log import Log
from sharpfield.training.loop import Hook
from sharpfield.training.memory import Losses, peak_memory_mb


@dataclass(frozen=True)
class Ledger:
    """A run's length and its cost so far, as reported in `RUN/training.json`."""

    planned_steps: int
    """Length of the whole run."""
    parts: int
    """Parts in which each batch is worked off."""
    device: str
    steps: int = 0
    """Steps done."""
    seconds: float = 0.0
    """Spent on them, over all sessions."""
    peak_memory_mb: float = 0.0
    """Most memory the process used; of the device, if it has its own."""

    @property
    def finished(self) -> bool:
        """Whether all planned steps are done."""
        return self.steps >= self.planned_steps


def write_ledger(run: Path, ledger: Ledger) -> None:
    """Write `RUN/training.json`."""
    write_json(run / "training.json", dataclasses.asdict(ledger))


def read_ledger(run: Path) -> Ledger | None:
    """Read `RUN/training.json`; None if the run has not begun.

    Raises:
        RunError: It is damaged.
    """
    path = run / "training.json"
    if not path.is_file():
        return None
    try:
        return Ledger(**json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise RunError(
            "the record of the training cannot be read",
            where=path,
            got=error,
            do="delete it; only the time spent so far is lost",
        ) from None


class Record:
    """Keeps the checkpoints and the ledger of a run; its methods are hooks."""

    def __init__(self, run: Path, log: Log, ledger: Ledger, progress: Progress) -> None:
        """Begin a session.

        Args:
            run: The run's folder.
            log: Knows the time spent; validation scores go there.
            ledger: Of the sessions before.
            progress: Where this session begins.
        """
        self.run, self.log, self.ledger, self.progress = run, log, ledger, progress
        self.unsaved = progress.step == 0

    def count(self, step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        """Remember that a step is done."""
        self.progress = dataclasses.replace(self.progress, step=step + 1)
        self.unsaved = True

    def save(self, step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        """Save everything as it is after the last counted step."""
        self.flush(model, optimizer)

    def keep_best(self, validate: Callable[[Model], float]) -> Hook:
        """A hook that scores the model, and saves its weights if they are the best so far."""

        def score(step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
            value, best = validate(model), self.progress.best
            self.log.record(step + 1, {"validation": value})
            if math.isfinite(value) and (best is None or value > best):
                self.progress = dataclasses.replace(self.progress, best=value)
                save_best(self.run, model, self.progress)

        return score

    def flush(self, model: Model, optimizer: Optimizer) -> None:
        """Save what the last checkpoint does not hold yet; first the checkpoint, then its cost."""
        if self.unsaved:
            save_last(self.run, model, optimizer, self.progress)
            self.unsaved = False
        peak = max(self.ledger.peak_memory_mb, peak_memory_mb(device_of(model)))
        self.ledger = dataclasses.replace(
            self.ledger,
            steps=self.progress.step,
            seconds=round(self.log.seconds, 3),
            peak_memory_mb=round(peak, 1),
        )
        write_ledger(self.run, self.ledger)
