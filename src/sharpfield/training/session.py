"""A whole run: plan it, train, save, log, stop at a signal or when time is up, and resume.

Hooks, which are called after each step: functions `(step, model, optimizer, losses)`.
"""

import dataclasses
import itertools
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rich.console import Console
from torch import Tensor
from torch.optim import Optimizer

from sharpfield.core.errors import RunError
from sharpfield.core.measurements import Batch
from sharpfield.core.protocols import Model
from sharpfield.core.struct import device_of
from sharpfield.training.checkpoint import (
    Checkpoint,
    TrainingProgress,
    check_settings,
    recover,
    restore,
)
from sharpfield.training.log import LogLosses, TrainingLog
from sharpfield.training.loop import Hook, fit
from sharpfield.training.memory import Losses
from sharpfield.training.optim import adam
from sharpfield.training.options import TrainingOptions
from sharpfield.training.plan import Build, Plan, make_plan
from sharpfield.training.status import Checkpointer, TrainingStatus, read_status, write_status


def every(steps: int, hook: Hook, *, last: int | None = None) -> Hook:
    """Call `hook` after every `steps` steps, and after the last of a run of `last` steps."""

    def sometimes(step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        if (step + 1) % steps == 0 or step + 1 == last:
            hook(step, model, optimizer, losses)

    return sometimes


def every_seconds(
    seconds: float, hook: Hook, *, clock: Callable[[], float] = time.monotonic
) -> Hook:
    """Call `hook` after the first step that ends `seconds` or more after the last call."""
    last = clock()

    def sometimes(step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
        nonlocal last
        if clock() - last >= seconds:
            hook(step, model, optimizer, losses)
            last = clock()

    return sometimes


def require_finite(step: int, model: Model, optimizer: Optimizer, losses: Losses) -> None:
    """Stop training at a loss that is not finite.

    Raises:
        RunError: Names the loss, the step, and the range of each field of the batch.
    """
    values = torch.stack(list(losses.values()))
    if torch.isfinite(values).all():
        return
    terms = dict(zip(losses, values.tolist(), strict=True))
    ill = [name for name, loss in losses.items() if not torch.isfinite(loss)]
    raise RunError(
        f"the loss {' and '.join(map(repr, ill))} is not finite",
        where=f"step {step}; batch: {describe(model.draw(step))}",
        got=", ".join(f"{name} {value:.4g}" for name, value in terms.items()),
        do="lower the learning rate, or look for odd values in the batch above;"
        " the last checkpoint is from before and still good",
    )


def describe(batch: Batch) -> str:
    """A batch in one line: counts, and the range of each field."""
    return "; ".join(
        f"{name} ({len(seen)} {type(seen).__name__}): "
        + ", ".join(
            f"{field.name} {_range(value)}"
            for field in dataclasses.fields(seen)
            if isinstance(value := getattr(seen, field.name), Tensor)
        )
        for name, seen in batch.items()
    )


def _range(values: Tensor) -> str:
    good = values[torch.isfinite(values)]
    span = f"{good.min().item():.4g}...{good.max().item():.4g}" if good.numel() else "empty"
    ill = values.numel() - good.numel()
    return f"{span} and {ill} not finite" if ill else span


SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """While open, the first signal to stop ends training after the current step.

    A second one ends the program at once.
    """

    def __init__(self, *, minutes: float | None = None) -> None:
        """Stop after `minutes` from now; None for no limit."""
        self.deadline = None if minutes is None else time.monotonic() + 60 * minutes
        self.interrupted = ""
        self.earlier: dict[int, Any] = {}

    def __enter__(self) -> "Stop":
        if threading.current_thread() is threading.main_thread():
            self.earlier = {number: signal.signal(number, self._request) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore_handlers()

    @property
    def reason(self) -> str:
        """Why training should stop now; empty if it should not."""
        if self.interrupted:
            return self.interrupted
        return "the time is up" if self.seconds_left <= 0 else ""

    @property
    def seconds_left(self) -> float:
        """Time left; infinite without a limit."""
        return float("inf") if self.deadline is None else self.deadline - time.monotonic()

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = f"interrupted by {signal.Signals(number).name}"
        self._restore_handlers()

    def _restore_handlers(self) -> None:
        for number, handler in self.earlier.items():
            signal.signal(number, handler)
        self.earlier = {}


CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints, unless a number of steps is given."""
GUARD_STEPS = 100
"""Steps between checks of the losses on a GPU, each of which waits for the device."""


def train(
    build: Build,
    run: Path,
    options: TrainingOptions,
    *,
    steps: int,
    settings: Mapping[str, Any],
    validate: Callable[[Model], float] | None = None,
    console: Console | None = None,
) -> TrainingStatus:
    """Train a model in a run folder, from the start or from where it stopped.

    Args:
        build: Makes the model for a number of steps; may be called twice.
        run: Folder for `checkpoints/`, `log.csv` and `training.json`.
        options: How to train.
        steps: Length of the recipe's own schedule.
        settings: Recipe, seed and capture as JSON, which must be the same when resuming; not the
            number of steps.
        validate: Scores a model, higher is better; the weights with the best score are kept.
        console: Where progress is shown.

    Returns:
        Length and cost of the run; `finished` tells whether all steps are done.

    Raises:
        RunError: The folder holds another run, or a loss is not finite.
        KeyboardInterrupt: A signal stopped the training; everything is saved.
    """
    console = console or Console()
    with Stop(minutes=options.minutes) as stop:
        saved = _resumed(run, options, settings, console)
        if saved is None:
            plan, model = make_plan(build, options, steps=steps, seconds=stop.seconds_left)
            begin = TrainingProgress(0, plan.steps, plan.micro_batches, settings=dict(settings))
        else:
            plan = Plan(options.steps or saved.progress.planned_steps, saved.progress.micro_batches)
            model = build(plan.steps)
            begin = dataclasses.replace(saved.progress, planned_steps=plan.steps)
        optimizer = adam(model)
        if saved is not None:
            restore(saved, model, optimizer)
        device = device_of(model)
        status = _status(run, plan, begin, device.type)
        with TrainingLog(
            run, begin=begin.step, end=plan.steps, seconds=status.seconds, console=console
        ) as log:
            log.print_line(_opening(plan, begin.step))
            checkpointer = Checkpointer(run, log, status, begin)
            fit(
                model,
                optimizer,
                steps=itertools.takewhile(lambda _: not stop.reason, range(begin.step, plan.steps)),
                micro_batches=plan.micro_batches,
                hooks=_hooks(checkpointer, options, validate, device=device.type),
            )
            checkpointer.flush(model, optimizer)
    if not checkpointer.status.finished:
        console.print(
            f"Stopped after step {checkpointer.status.steps} of {plan.steps}: {stop.reason}."
            " Saved; to go on from here, train again with --resume (resume=True).",
            highlight=False,
            soft_wrap=True,
        )
    if stop.interrupted:
        raise KeyboardInterrupt
    return checkpointer.status


def require_unused(run: Path) -> None:
    """Refuse a folder in which training has begun before.

    Raises:
        RunError: It has.
    """
    if (run / "training.json").exists():
        raise RunError(
            "the folder already holds a run",
            where=run,
            do="go on with it by --resume (resume=True), or name another folder",
        )


def _resumed(
    run: Path, options: TrainingOptions, settings: Mapping[str, Any], console: Console
) -> Checkpoint | None:
    """The checkpoint to resume from; None for a run that starts at step 0."""
    if not options.resume:
        require_unused(run)
        return None
    saved, warning = recover(run)
    if warning:
        console.print(warning, highlight=False, soft_wrap=True)
    if saved is not None:
        check_settings(saved.progress.settings, settings)
    return saved


def _status(run: Path, plan: Plan, begin: TrainingProgress, device: str) -> TrainingStatus:
    """The status at the beginning of a session, also written to disk."""
    earlier = read_status(run) if begin.step else None
    status = TrainingStatus(
        planned_steps=plan.steps,
        micro_batches=plan.micro_batches,
        device=device,
        steps=begin.step,
        seconds=earlier.seconds if earlier else 0.0,
        peak_memory_mb=earlier.peak_memory_mb if earlier else 0.0,
    )
    write_status(run, status)
    return status


def _opening(plan: Plan, step: int) -> str:
    """The first line that is printed."""
    split = f", {plan.micro_batches} micro-batches each" if plan.micro_batches > 1 else ""
    if step:
        return f"Resuming at step {step} of {plan.steps}{split}"
    return f"Training {plan.steps} steps{split}"


def _hooks(
    checkpointer: Checkpointer,
    options: TrainingOptions,
    validate: Callable[[Model], float] | None,
    *,
    device: str,
) -> list[Hook]:
    """In this order, so that a step with a loss that is not finite is never logged or saved."""
    hooks = [
        every(1 if device == "cpu" else GUARD_STEPS, require_finite),
        checkpointer.count,
        LogLosses(checkpointer.log, every=options.log_every),
    ]
    if validate is not None:
        last = checkpointer.progress.planned_steps
        hooks.append(every(options.validate_every, checkpointer.keep_best(validate), last=last))
    if options.checkpoint_every is None:
        hooks.append(every_seconds(CHECKPOINT_SECONDS, checkpointer.save))
    else:
        hooks.append(every(options.checkpoint_every, checkpointer.save))
    return hooks
