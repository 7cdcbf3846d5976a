"""The training loop.

A *hook* is called after every step: logs, checkpoints and the check that losses are finite are
hooks. A *micro-batch* is a share of a step's batch that fits in memory; gradients accumulate over
the micro-batches of a step (`memory.py`).

Hooks, which are called after each step: functions `(step, model, optimizer, losses)`.
"""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor
from torch.optim import Optimizer

from sharpfield.core.errors import RunError
from sharpfield.core.measurements import Batch
from sharpfield.core.protocols import Growing, Model
from sharpfield.training.optim import apply_growth, set_rates
from sharpfield.training.plan import Losses, accumulate

Hook = Callable[[int, Model, Optimizer, Losses], None]
"""Called with the step just done, the model, the optimizer and the detached loss terms."""


def fit(
    model: Model,
    optimizer: Optimizer,
    *,
    steps: Iterable[int],
    micro_batches: int = 1,
    hooks: Sequence[Hook] = (),
) -> None:
    """Train for some steps. To resume, begin at the saved step: a batch depends on its step alone.

    Args:
        model: To be trained.
        optimizer: Of `optim.adam`.
        steps: Usually a range; an iterator that ends early ends training between two steps.
        micro_batches: In how many micro-batches each batch is split; their gradients add up.
        hooks: Called in this order after each step.
    """
    for step in steps:
        set_rates(optimizer, model.groups(), step)
        optimizer.zero_grad(set_to_none=True)
        losses = accumulate(model, model.draw(step), step, micro_batches=micro_batches)
        optimizer.step()
        for part, growth in model.grow(step) if isinstance(model, Growing) else ():
            apply_growth(part, optimizer, growth)
        for hook in hooks:
            hook(step, model, optimizer, losses)


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
