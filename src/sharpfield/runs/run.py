"""A run from the command line's point of view: start one, open one again, measure it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from rich.console import Console

from sharpfield.captures.blocks import blocks_of, limited, parsed
from sharpfield.captures.read import read
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError, RunError
from sharpfield.core.progress import progress_on
from sharpfield.core.protocols import Model
from sharpfield.evaluation.evaluate import Measuring, evaluate
from sharpfield.evaluation.report import Story, write_report
from sharpfield.evaluation.views import validation
from sharpfield.runs.config import RunConfig, read_run_config, write_run_config
from sharpfield.training.checkpoint import file_of, load, restore_weights
from sharpfield.training.plan import Options
from sharpfield.training.record import Ledger, read_ledger
from sharpfield.training.session import require_unused, train

STREAMS = ("frames", "events")


@dataclass(frozen=True)
class ReadOptions:
    """How to read a capture, where its layout is not to be believed."""

    layout: str | None = None
    """By default it is recognised."""
    event_unit: str | None = None
    """Unit of event times: ns, us, ms or s."""
    missing: Literal["error", "skip"] | None = None
    """What to do about images that are named but not there."""
    encoding: str | None = None
    """How stored values relate to light: linear, gamma2.2 or srgb."""
    hold_out: str | None = None
    """Frames to hold out: every:8, train:5, last:5 or none."""
    threshold: float | None = None
    """Contrast threshold of both signs."""
    trust_pickle: bool = False
    """Open pickled files, which may name programs to run; only arrays of numbers are built from
    them, and anything else is refused."""

    def given(self) -> dict[str, Any]:
        """What was not left open."""
        return {name: value for name, value in vars(self).items() if value not in (None, False)}


@dataclass(frozen=True)
class OpenedRun:
    """A trained run."""

    started: RunConfig
    model: Any
    capture: Capture
    """All of it, or its block; also what the model did not use."""

    @property
    def seen(self) -> Capture:
        """The capture in the model's world, also with frames that the model did not use."""
        own: Capture = self.model.capture
        if own.frames is not None:
            return own
        return replace(own, frames=self.capture.frames, split=self.capture.split)


def device_named(name: str) -> str:
    """`auto` becomes cuda where there is one.

    Raises:
        OptionError: cuda was asked for and is not there.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise OptionError("there is no CUDA device", do="use --device cpu")
    return name


def used(capture: Capture, streams: tuple[str, ...]) -> Capture:
    """A capture with only some of its streams; without events, if its camera reported none.

    Raises:
        OptionError: A name is unknown.
        CaptureError: Nothing is left.
    """
    if unknown := set(streams) - set(STREAMS):
        raise OptionError("unknown stream", got=", ".join(unknown), do="use frames, events or both")
    missing = {"frames": not capture.frames, "events": not capture.events}
    left = [name for name in streams if not missing[name]]
    if not left:
        raise CaptureError(
            f"the capture has no {' or '.join(streams)}", where=capture.name, do="use what it has"
        )
    return capture.without(frames="frames" not in left, events="events" not in left)


def part_of(capture: Capture, block: str) -> Capture:
    """The block of a capture that "2/4" names; all of it if nothing does."""
    if not block:
        return capture
    index, count = parsed(block)
    return limited(capture, blocks_of(capture, count)[index])


def start(
    started: RunConfig,
    capture: Capture,
    run: Path,
    options: Options,
    *,
    device: str,
    console: Console,
) -> Ledger:
    """Train a recipe on a capture in a run folder, or go on with it."""
    part = part_of(capture, started.block)
    chosen = used(part, started.use)

    def build(steps: int) -> Model:
        return started.recipe.lasting(steps).build(chosen, started.seed).to(device)

    if not options.resume:
        require_unused(run)
        write_run_config(run, started)
    return train(
        build,
        run,
        options,
        steps=started.recipe.steps,
        settings=started.settings(),
        validate=validation(part),
        console=console,
    )


def open_run(run: Path, *, capture: Path | None = None, device: str = "auto") -> OpenedRun:
    """A run with its trained weights.

    Args:
        run: Folder that `train` made.
        capture: Where the capture is now, if it moved; or another one of the same scene and clock.
        device: Where the model goes.

    Raises:
        RunError: The run has no checkpoint yet, or is damaged.
    """
    started, ledger = read_run_config(run), read_ledger(run)
    if ledger is None:
        raise RunError("this run has not begun", where=run, do="train it first")
    source = Path(started.capture) if capture is None else capture
    if not source.exists():
        raise CaptureError(
            "the capture of this run is gone",
            where=run,
            got=source,
            do="say where it is now with --capture",
        )
    whole = part_of(read(source, **started.reading), started.block)
    model = started.recipe.lasting(ledger.planned_steps).build(
        used(whole, started.use), started.seed
    )
    restore_weights(load(file_of(run, "last")), model)
    return OpenedRun(started, model.to(device_named(device)), whole)


def measure(
    opened: OpenedRun,
    run: Path,
    console: Console,
    *,
    measuring: Measuring | None = None,
    baselines: Mapping[str, Mapping[str, Any]] | None = None,
    title: str = "",
) -> dict[str, Any]:
    """Evaluate a run and write its report."""
    started = opened.started
    with progress_on(console) as progress:
        task = progress.add_task("rendering", total=None)
        metrics = evaluate(
            opened.model,
            opened.capture,
            run,
            measuring=measuring,
            baselines=baselines,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    story = Story(
        title=title or f"{started.name} on {opened.capture.name}",
        paper=started.recipe.paper,
        settings=started.settings(),
    )
    write_report(run, opened.capture, metrics, story)
    return metrics
