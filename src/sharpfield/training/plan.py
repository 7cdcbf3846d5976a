"""The length and the micro-batches of a run: chosen when it starts, kept when it is resumed."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from sharpfield.core.protocols import Model
from sharpfield.core.struct import device_of
from sharpfield.training.loop import fit
from sharpfield.training.memory import GIB, MEMORY_FRACTION, available_bytes, plan_micro_batches
from sharpfield.training.optim import adam
from sharpfield.training.options import TrainingOptions

Build = Callable[[int], Model]
"""Builds the model, on its device, with schedules for a number of steps."""

PROBES = (0.0, 0.25, 0.5, 0.75)
"""Fractions of the schedule where the duration of a step is measured."""
TIME_FRACTION = 0.93
"""Fraction of the time that is planned for steps; the rest is for checkpoints and logs."""


@dataclass(frozen=True)
class Plan:
    """Number of steps of a run, and of micro-batches of each step."""

    steps: int
    micro_batches: int


def make_plan(
    build: Build, options: TrainingOptions, *, steps: int, seconds: float
) -> tuple[Plan, Model]:
    """Choose steps and micro-batches of a new run, and build its model.

    Args:
        build: Makes the model; called twice when the length depends on the time.
        options: How to train.
        steps: Length of the recipe's own schedule.
        seconds: Time for the whole run, where `options.minutes` is given.
    """
    schedule = options.steps or steps
    model = build(schedule)
    if options.memory_gb is None:
        budget = MEMORY_FRACTION * available_bytes(device_of(model))
    else:
        budget = options.memory_gb * GIB
    micro_batches = plan_micro_batches(model, budget_bytes=int(budget))
    if options.minutes is None:
        return Plan(schedule, micro_batches), model
    affordable = affordable_steps(
        model, seconds=seconds, schedule=schedule, micro_batches=micro_batches
    )
    del model  # trained by the measurement; two models at once may not fit in memory
    return Plan(affordable, micro_batches), build(affordable)


def affordable_steps(model: Model, *, seconds: float, schedule: int, micro_batches: int) -> int:
    """How many steps fit into a time, measured on a few steps across the schedule.

    This trains the model a little; build it anew afterwards.

    Args:
        model: Built for a schedule of any length.
        seconds: Time for all steps, including those measured here.
        schedule: Length of the schedule the model was built for.
        micro_batches: Of each step.
    """
    begun = time.monotonic()
    optimizer = adam(model)
    device = device_of(model)

    def cost(step: int) -> float:
        start = time.monotonic()
        fit(model, optimizer, steps=[step], micro_batches=micro_batches)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.monotonic() - start

    cost(model.heaviest_step)  # compiles and allocates
    costs = [cost(int(schedule * probe)) for probe in PROBES]
    left = TIME_FRACTION * (seconds - (time.monotonic() - begun))
    return max(int(left / (sum(costs) / len(costs))), 1)
