"""How far a run is and what it has cost: its checkpoints and `training.json`."""

import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from torch.optim import Optimizer

from sharpfield.core.errors import RunError
from sharpfield.core.files import write_json
from sharpfield.core.protocols import Model
from sharpfield.core.struct import device_of
from sharpfield.training.checkpoint import TrainingProgress, save_best, save_last
from sharpfield.training.log import TrainingLog
from sharpfield.training.loop import Hook
from sharpfield.training.memory import Losses, peak_memory_mb


@dataclass(frozen=True)
class TrainingStatus:
    """Length of a run and its cost so far, as in `RUN/training.json`."""

    planned_steps: int
    """Length of the whole run."""
    micro_batches: int
    """Micro-batches of each step."""
    device: str
    steps: int = 0
    """Steps done."""
    seconds: float = 0.0
    """Training time, over all sessions."""
    peak_memory_mb: float = 0.0
    """Peak memory of the process; of the device, if it has its own. In MiB."""

    @property
    def finished(self) -> bool:
        """Whether all planned steps are done."""
        return self.steps >= self.planned_steps


def write_status(run: Path, status: TrainingStatus) -> None:
    """Write `RUN/training.json`."""
    write_json(run / "training.json", dataclasses.asdict(status))


def read_status(run: Path) -> TrainingStatus | None:
    """Read `RUN/training.json`; None if the run has not begun.

    Raises:
        RunError: It is damaged.
    """
    path = run / "training.json"
    if not path.is_file():
        return None
    try:
        return TrainingStatus(**json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise RunError(
            "the status of the training cannot be read",
            where=path,
            got=error,
            do="delete it; only the time spent so far is lost",
        ) from None


class Checkpointer:
    """Writes the checkpoints and the status of a run; its methods are hooks."""

    def __init__(
        self, run: Path, log: TrainingLog, status: TrainingStatus, progress: TrainingProgress
    ) -> None:
        """Begin a session.

        Args:
            run: Folder of the run.
            log: Measures the time; gets validation scores.
            status: After the sessions before.
            progress: Where this session begins.
        """
        self.run, self.log, self.status, self.progress = run, log, status, progress
        self.unsaved = progress.step == 0

    def count(self, step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        """Note that a step is done."""
        self.progress = dataclasses.replace(self.progress, step=step + 1)
        self.unsaved = True

    def save(self, step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        """Save the state after the last counted step."""
        self.flush(model, optimizer)

    def keep_best(self, validate: Callable[[Model], float]) -> Hook:
        """A hook that scores the model and saves its weights where they are the best so far."""

        def score(step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
            value, best = validate(model), self.progress.best
            self.log.record(step + 1, {"validation": value})
            if math.isfinite(value) and (best is None or value > best):
                self.progress = dataclasses.replace(self.progress, best=value)
                save_best(self.run, model, self.progress)

        return score

    def flush(self, model: Model, optimizer: Optimizer) -> None:
        """Save what the last checkpoint does not hold yet: the checkpoint, then the status."""
        if self.unsaved:
            save_last(self.run, model, optimizer, self.progress)
            self.unsaved = False
        peak = max(self.status.peak_memory_mb, peak_memory_mb(device_of(model)))
        self.status = dataclasses.replace(
            self.status,
            steps=self.progress.step,
            seconds=round(self.log.seconds, 3),
            peak_memory_mb=round(peak, 1),
        )
        write_status(self.run, self.status)
