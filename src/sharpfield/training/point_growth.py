"""Points added, pruned and relocated during training: parameters and optimizer state change alike.

Adam's moments follow the rows they belong to. They restart at zero for fresh points and for values
that differ from their source row. State of a parameter as a whole (its step count) is kept.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from sharpfield.core.protocols import Growth, PointSet


def apply_growth(part: PointSet, optimizer: Optimizer, growth: Growth) -> None:
    """Replace the points of a module, and the optimizer's parameters and moments with them.

    Args:
        part: Gets new parameters and buffers.
        optimizer: Gets the new parameters in place of the old ones. Parameters that it does not
            train are only replaced in `part`.
        growth: Which rows the new points are copied from.
    """
    old = part.points()
    assert growth.values.keys() <= old.keys(), f"no points named {growth.values.keys() - old}"
    with torch.no_grad():
        copied = {name: rows[growth.source] for name, rows in old.items()}
        new = copied | growth.values
        restarted = {name: _restarted(copied[name], new[name], growth) for name in old}
    part.replace(new)
    parameters = {name: rows for name, rows in old.items() if isinstance(rows, nn.Parameter)}
    grown = part.points()
    for name, parameter in parameters.items():
        if parameter in optimizer.state:
            state = optimizer.state.pop(parameter)
            optimizer.state[grown[name]] = {
                moment: _moved(value, parameter, growth, restarted[name])
                for moment, value in state.items()
            }
    replace_parameters(optimizer, {old[name]: grown[name] for name in parameters})


def resize(part: PointSet, count: int) -> None:
    """Give a module a number of points, all zero, to be loaded."""
    part.replace(
        {name: rows.new_zeros(count, *rows.shape[1:]) for name, rows in part.points().items()}
    )


def replace_parameters(optimizer: Optimizer, successors: Mapping[Tensor, Tensor]) -> None:
    """Replace parameters in the optimizer's groups."""
    for group in optimizer.param_groups:
        group["params"] = [successors.get(old, old) for old in group["params"]]


def _restarted(copied: Tensor, new: Tensor, growth: Growth) -> Tensor:
    """Which values of a parameter restart with moments of zero."""
    fresh = growth.fresh.view(-1, *[1] * (new.ndim - 1))
    return (new != copied) | fresh


def _moved(value: Tensor, parameter: Tensor, growth: Growth, restarted: Tensor) -> Tensor:
    """Optimizer state of the new parameter; state without rows belongs to all of it."""
    if value.shape == parameter.shape:
        return value[growth.source].masked_fill_(restarted, 0)
    if value.shape == parameter.shape[:1]:
        return value[growth.source].masked_fill_(growth.fresh, 0)
    return value
