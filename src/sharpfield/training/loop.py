"""The training loop.

A *hook* is called after every step: logs, checkpoints and the check that losses are finite are
hooks. A *micro-batch* is a share of a step's batch that fits in memory; gradients accumulate over
the micro-batches of a step (`memory.py`).
"""

from collections.abc import Callable, Iterable, Sequence

from torch.optim import Optimizer

from sharpfield.core.protocols import Growing, Model
from sharpfield.training.memory import Losses, accumulate
from sharpfield.training.optim import apply_growth, set_rates

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
