"""Seconds and memory of one whole training step of Ev-DeblurNeRF, against the plain formulation.

    python -m benchmarks.training_step [--parts 16 1] [--runs 3] [--threads 2] [--capture FOLDER]

A step is: draw, losses, gradients, Adam, at iteration 1200, where everything is switched on. The
batch is the paper's (1024 pixels of 10 rays, 4096 pairs of events of 2, 64 + 128 samples on each)
or one of so many equal parts of it; the volumes are always the paper's. Every contender runs in a
process of its own and starts from the same parameters, so that the losses must agree. A batch that
does not fit in memory is halved until it does.

Seconds are the best of the runs; with `--threads 1` they are CPU seconds, which other
programs on the machine do not disturb. Memory is the most that the process held during a step, less
what it held before the model was built. Linux only, for the peak.
"""

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import torch
from torch.optim import Adam, Optimizer

from benchmarks.plain import Plain
from benchmarks.table import Row, save, show
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF, Model
from sharpfield.simulation.static_capture import Rig, simulate
from sharpfield.training.memory import available_bytes, saved_bytes
from sharpfield.training.optim import adam

ATELIER = Path(__file__).parents[1].parent / "shared" / "data" / "blender" / "atelier"
"""The usual capture, 300x200; simulated where it is absent."""

SHARE = 0.8
"""Of the free memory that a contender may take."""

GIB = 2**30


@dataclass(frozen=True)
class Contender:
    """A formulation, and what its heads compute in."""

    name: str
    precision: str = "float32"


PLAIN = Contender("plain")
OURS = Contender("sharpfield"), Contender("sharpfield, bfloat16", "bfloat16")


@dataclass(frozen=True)
class Task:
    """What one process measures."""

    contender: Contender
    parts: int
    runs: int
    threads: int
    capture: Path


@dataclass(frozen=True)
class Measured:
    """What it found."""

    seconds: float
    peak: int
    """Bytes, with parameters, their gradients and Adam's moments."""
    kept: int
    """Bytes that the forward pass keeps for the backward pass, without parameters."""
    losses: dict[str, float]
    """Of the first step."""


def captured(folder: Path) -> Capture:
    """The capture in a folder, or a simulated one of the same size if there is none."""
    return read_capture(folder) if folder.exists() else simulate(rig=Rig((300, 200)))


def recipe_for(contender: Contender, parts: int) -> EvDeblurNeRF:
    """The paper's recipe on one of so many equal parts of the batch."""
    recipe = EvDeblurNeRF()
    frames, events = recipe.frames, recipe.events
    return replace(
        recipe,
        frames=replace(frames, blurred_pixels=frames.blurred_pixels // parts),
        events=replace(events, pairs=events.pairs // parts),
        volume=replace(recipe.volume, precision=contender.precision),
    )


def built(
    contender: Contender, capture: Capture, parts: int, *, device: str = "cpu"
) -> tuple[Model | Plain, Optimizer]:
    """A model and its optimizer; the parameters depend on the seed alone."""
    model = recipe_for(contender, parts).build(capture, seed=0).to(device)
    if contender == PLAIN:
        plain = Plain(model)
        return plain, Adam(plain.parameters(), lr=plain.recipe.lr)
    return model, adam(model)


def take_step(model: Model | Plain, optimizer: Optimizer, step: int) -> dict[str, float]:
    """One step as training does it."""
    optimizer.zero_grad(set_to_none=True)
    losses = model.losses(model.draw(step), step)
    torch.stack(list(losses.values())).sum().backward()
    optimizer.step()
    return {name: loss.item() for name, loss in losses.items()}


def measure(task: Task) -> Measured | None:
    """Build and take steps; None if the memory does not suffice."""
    torch.set_num_threads(task.threads)
    clock = time.process_time if task.threads == 1 else time.perf_counter
    capture = captured(task.capture)
    before = memory_kb("VmRSS")
    model, optimizer = built(task.contender, capture, task.parts)
    step = model.recipe.frames.blur_from - 1
    limit = memory_kb("VmData") * 1024 + int(SHARE * available_bytes(torch.device("cpu")))
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    seconds: list[float] = []
    losses: list[dict[str, float]] = []
    try:
        kept = saved_bytes(model, model.draw(step), step)  # also compiles
        Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
        for _ in range(task.runs):
            start = clock()
            losses.append(take_step(model, optimizer, step))
            seconds.append(clock() - start)
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, RuntimeError) and "memory" not in str(error):
            raise
        return None
    peak = 1024 * (memory_kb("VmHWM") - before)
    return Measured(min(seconds), peak, kept, losses[0])


def memory_kb(name: str) -> int:
    """A number of `/proc/self/status`."""
    status = Path("/proc/self/status").read_text()
    return int(status.split(f"{name}:")[1].split()[0])


def alone(measure_: Callable[[Task], Measured | None], task: Task) -> Measured | None:
    """Measure in a new process, whose memory is its own."""
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(measure_, (task,))


def share(parts: int) -> str:
    """How much of the batch, in words of a table."""
    return f"1/{parts}" if parts > 1 else "all"


def row(task: Task, found: Measured, against: Measured | None) -> Row:
    """A line of the table, with how many times more the plain formulation takes where it fits."""
    return {
        "contender": task.contender.name,
        "batch": share(task.parts),
        "s": found.seconds,
        "peak GiB": found.peak / GIB,
        "kept GiB": found.kept / GIB,
        "loss": sum(found.losses.values()),
        "s ratio": against and against.seconds / found.seconds,
        "peak ratio": against and against.peak / found.peak,
        "kept ratio": against and against.kept / found.kept,
    }


def compare(wanted: Task) -> list[Row]:
    """Lines for all contenders at the largest part of the batch that fits for the plain one.

    Ours are measured at the wanted part too.
    """
    task = wanted
    while (plain := alone(measure, task)) is None:
        print(f"plain: {share(task.parts)} of the batch does not fit", flush=True)
        task = replace(task, parts=2 * task.parts)
    rows = [row(task, plain, plain)]
    for part, against in {wanted.parts: None, task.parts: plain}.items():
        for contender in OURS:
            ours = replace(task, contender=contender, parts=part)
            if (found := alone(measure, ours)) is not None:
                rows.append(row(ours, found, against))
    show(rows)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--parts", type=int, nargs="+", default=[16, 1])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--capture", type=Path, default=ATELIER)
    options = parser.parse_args()
    clock = "CPU seconds" if options.threads == 1 else "seconds"
    print(f"{clock}, {options.threads} thread(s), best of {options.runs}")
    rows: list[Row] = []
    for parts in options.parts:
        task = Task(PLAIN, parts, options.runs, options.threads, options.capture)
        rows += compare(task)
    facts = {key: str(value) for key, value in vars(options).items()}
    facts["capture"] = options.capture.name
    print(save("training_step", rows, facts))


if __name__ == "__main__":
    main()
