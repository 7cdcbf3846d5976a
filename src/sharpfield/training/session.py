"""A whole run: plan it, train, save, log, stop politely, and go on where it stopped.

When to end training early, between two steps: a signal, or time that is up.
"""

import dataclasses
import itertools
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from rich.console import Console

from sharpfield.core.device import device_of
from sharpfield.core.errors import RunError
from sharpfield.core.protocols import Model
from sharpfield.training.checkpoint import Checkpoint, Progress, check_settings, recover, restore
from sharpfield.training.hooks import every, every_seconds, finite
from sharpfield.training.log import Log, LogLosses
from sharpfield.training.loop import Hook, fit
from sharpfield.training.optim import adam
from sharpfield.training.options import Options
from sharpfield.training.plan import Build, Plan, make_plan
from sharpfield.training.record import Ledger, Record, read_ledger, write_ledger

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """While open, turns the first interrupt into a request to end after the step under way.

    A second interrupt ends the program at once, as it would without this.
    """

    def __init__(self, *, minutes: float | None = None) -> None:
        """Allow `minutes` from now; None for as long as it takes."""
        self.deadline = None if minutes is None else time.monotonic() + 60 * minutes
        self.interrupted = ""
        self.earlier: dict[int, Any] = {}

    def __enter__(self) -> "Stop":
        if threading.current_thread() is threading.main_thread():
            self.earlier = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._give_back()

    @property
    def reason(self) -> str:
        """Why training should end now; empty if it should not."""
        if self.interrupted:
            return self.interrupted
        return "the time is up" if self.seconds_left <= 0 else ""

    @property
    def seconds_left(self) -> float:
        """Until the time is up."""
        return float("inf") if self.deadline is None else self.deadline - time.monotonic()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = f"interrupted by {signal.Signals(number).name}"
        self._give_back()

    def _give_back(self) -> None:
        for number, handler in self.earlier.items():
            signal.signal(number, handler)
        self.earlier = {}


CHECKPOINT_SECONDS = 60.0
"""Between checkpoints, unless a number of steps is given."""
GUARD_STEPS = 100
"""Between looks at the losses on a GPU, which has to be waited for each time."""


def train(
    build: Build,
    run: Path,
    options: Options,
    *,
    steps: int,
    settings: Mapping[str, Any],
    validate: Callable[[Model], float] | None = None,
    console: Console | None = None,
) -> Ledger:
    """Train a model in a run folder, from the start or from where it stopped.

    Args:
        build: Makes the model for a number of steps; may be called twice.
        run: Folder for `checkpoints/`, `log.csv` and `training.json`.
        options: How to train.
        steps: Length of the recipe's own schedule.
        settings: What must be the same when resuming, as JSON: recipe, seed, capture; not the
            number of steps.
        validate: A score of the model, higher is better; the best weights are kept.
        console: Where to show progress.

    Returns:
        Length and cost of the run; `finished` tells whether all steps are done.

    Raises:
        RunError: The folder holds another run, or a loss is not finite.
        KeyboardInterrupt: A signal came; everything is saved, and whatever was to follow is not.
    """
    console = console or Console()
    with Stop(minutes=options.minutes) as stop:
        saved = _resumed(run, options, settings, console)
        if saved is None:
            plan, model = make_plan(build, options, steps=steps, seconds=stop.seconds_left)
            begin = Progress(0, plan.steps, plan.parts, settings=dict(settings))
        else:
            plan = Plan(options.steps or saved.progress.planned_steps, saved.progress.parts)
            model = build(plan.steps)
            begin = dataclasses.replace(saved.progress, planned_steps=plan.steps)
        optimizer = adam(model)
        if saved is not None:
            restore(saved, model, optimizer)
        device = device_of(model)
        ledger = _ledger(run, plan, begin, device.type)
        with Log(
            run, begin=begin.step, end=plan.steps, seconds=ledger.seconds, console=console
        ) as log:
            log.say(_opening(plan, begin.step))
            record = Record(run, log, ledger, begin)
            fit(
                model,
                optimizer,
                steps=itertools.takewhile(lambda _: not stop.reason, range(begin.step, plan.steps)),
                parts=plan.parts,
                hooks=_hooks(record, options, validate, device=device.type),
            )
            record.flush(model, optimizer)
    if not record.ledger.finished:
        console.print(
            f"Stopped after step {record.ledger.steps} of {plan.steps}: {stop.reason}."
            " Saved; the same command with --resume goes on from here.",
            highlight=False,
            soft_wrap=True,
        )
    if stop.interrupted:
        raise KeyboardInterrupt
    return record.ledger


def require_unused(run: Path) -> None:
    """Refuse a folder in which training has begun before.

    Raises:
        RunError: It has.
    """
    if (run / "training.json").exists():
        raise RunError(
            "the folder already holds a run",
            where=run,
            do="go on with it by --resume, or name another folder",
        )


def _resumed(
    run: Path, options: Options, settings: Mapping[str, Any], console: Console
) -> Checkpoint | None:
    """The state to go on from; None for a run that starts at its beginning."""
    if not options.resume:
        require_unused(run)
        return None
    saved, warning = recover(run)
    if warning:
        console.print(warning, highlight=False, soft_wrap=True)
    if saved is not None:
        check_settings(saved.progress.settings, settings)
    return saved


def _ledger(run: Path, plan: Plan, begin: Progress, device: str) -> Ledger:
    """The ledger at the beginning of a session, also on disk."""
    earlier = read_ledger(run) if begin.step else None
    ledger = Ledger(
        planned_steps=plan.steps,
        parts=plan.parts,
        device=device,
        steps=begin.step,
        seconds=earlier.seconds if earlier else 0.0,
        peak_memory_mb=earlier.peak_memory_mb if earlier else 0.0,
    )
    write_ledger(run, ledger)
    return ledger


def _opening(plan: Plan, step: int) -> str:
    parts = f", each batch in {plan.parts} parts to fit in memory" if plan.parts > 1 else ""
    where = f"Resuming at step {step} of {plan.steps}" if step else f"Training {plan.steps} steps"
    return where + parts


def _hooks(
    record: Record,
    options: Options,
    validate: Callable[[Model], float] | None,
    *,
    device: str,
) -> list[Hook]:
    """In this order: nothing is counted, logged or saved of a step that went wrong."""
    hooks = [
        every(1 if device == "cpu" else GUARD_STEPS, finite),
        record.count,
        LogLosses(record.log, every=options.log_every),
    ]
    if validate is not None:
        last = record.progress.planned_steps
        hooks.append(every(options.validate_every, record.keep_best(validate), last=last))
    if options.checkpoint_every is None:
        hooks.append(every_seconds(CHECKPOINT_SECONDS, record.save))
    else:
        hooks.append(every(options.checkpoint_every, record.save))
    return hooks
