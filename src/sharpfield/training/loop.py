"""The training loop, short enough to read aloud.

A *hook* is called after every step; logs, checkpoints and the guard against losses that are not
finite are hooks. A *part* is a share of a step's batch that fits in memory (`memory.py`).
"""

from collections.abc import Callable, Iterable, Sequence

from torch.optim import Optimizer

from sharpfield.core.protocols import Growing, Model
from sharpfield.training.memory import Losses, accumulate
from sharpfield.training.optim import set_rates
from sharpfield.training.surgery import rebuild

Hook = Callable[[int, Model, Optimizer, Losses], None]
"""Called with the step just done, the model, the optimizer and the detached loss terms."""


def fit(
    model: Model,
    optimizer: Optimizer,
    *,
    steps: Iterable[int],
    parts: int = 1,
    hooks: Sequence[Hook] = (),
) -> None:
    """Run `steps`. To resume, begin at the saved step: a draw depends on its step alone.

    Args:
        model: What is trained.
        optimizer: Of `optim.adam`.
        steps: Usually a range; whatever ends it early ends training between two steps.
        parts: Shares in which each batch is worked off; their gradients add up.
        hooks: Called in this order after each step.
    """
    for step in steps:
        set_rates(optimizer, model.groups(), step)
        optimizer.zero_grad(set_to_none=True)
        losses = accumulate(model, model.draw(step), step, parts=parts)
        optimizer.step()
        for part, growth in model.grow(step) if isinstance(model, Growing) else ():
            rebuild(part, optimizer, growth)
        for hook in hooks:
            hook(step, model, optimizer, losses)
