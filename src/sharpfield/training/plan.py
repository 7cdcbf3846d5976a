"""What a run decides once, at its start, and repeats whenever it is resumed."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from sharpfield.core.device import device_of
from sharpfield.core.protocols import Model
from sharpfield.training.loop import fit
from sharpfield.training.memory import GIB, SHARE, available_bytes, plan_parts
from sharpfield.training.optim import adam
from sharpfield.training.options import Options

Build = Callable[[int], Model]
"""Makes the model, on its device, with schedules for so many steps."""

PROBES = (0.0, 0.25, 0.5, 0.75)
"""Where in the schedule the duration of a step is measured."""
SLACK = 0.93
"""Part of the time that steps may fill; the rest is for checkpoints, logs and chance."""


@dataclass(frozen=True)
class Plan:
    """Length of a run, and parts in which each of its batches is worked off."""

    steps: int
    parts: int


def make_plan(build: Build, options: Options, *, steps: int, seconds: float) -> tuple[Plan, Model]:
    """Decide length and parts of a new run, and build its model.

    Args:
        build: Makes the model; called twice when the length depends on the time.
        options: How to train.
        steps: Length of the recipe's own schedule.
        seconds: For the whole run, if `options.minutes` is given.
    """
    schedule = options.steps or steps
    model = build(schedule)
    if options.memory_gb is None:
        budget = SHARE * available_bytes(device_of(model))
    else:
        budget = options.memory_gb * GIB
    parts = plan_parts(model, budget_bytes=int(budget))
    if options.minutes is None:
        return Plan(schedule, parts), model
    affordable = affordable_steps(model, seconds=seconds, schedule=schedule, parts=parts)
    del model  # the trials have trained it, and two at once may not fit
    return Plan(affordable, parts), build(affordable)


def affordable_steps(model: Model, *, seconds: float, schedule: int, parts: int) -> int:
    """How many steps fit into some time, from trying a few across the schedule.

    The model is trained a little by this; build it anew afterwards.

    Args:
        model: Built for a schedule of any length.
        seconds: To be filled with steps; the trials are paid from it.
        schedule: Length of the schedule the model was built for.
        parts: Parts in which each batch will be worked off.
    """
    begun = time.monotonic()
    optimizer = adam(model)
    device = device_of(model)

    def cost(step: int) -> float:
        start = time.monotonic()
        fit(model, optimizer, steps=[step], parts=parts)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.monotonic() - start

    cost(model.heaviest_step)  # compiles and allocates what later steps find ready
    costs = [cost(int(schedule * probe)) for probe in PROBES]
    left = SLACK * (seconds - (time.monotonic() - begun))
    return max(int(left / (sum(costs) / len(costs))), 1)
