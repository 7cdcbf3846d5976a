"""Points that grow and die under a running optimizer: the one place that moves its state with them.

The *moments* of a parameter are what the optimizer remembers of each of its numbers. They follow
the rows they belong to, and start over at zero for points that are fresh and for numbers that were
set to something else than their source has. What the optimizer counts for a parameter as a whole
(its steps) stays.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from sharpfield.core.points import Growth
from sharpfield.core.protocols import PointSet


def rebuild(part: PointSet, optimizer: Optimizer, growth: Growth) -> None:
    """Let the points of a part of a model grow, and the optimizer's moments with them.

    Args:
        part: Gets new parameters and buffers in place of its present ones.
        optimizer: Gets the new parameters at the places of the old ones. Parameters it does not
            have are left to themselves.
        growth: What the new points are made of.
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
    repoint(optimizer, {old[name]: grown[name] for name in parameters})


def resize(part: PointSet, count: int) -> None:
    """Make room for a number of points; they are all zero, to be loaded."""
    part.replace(
        {name: rows.new_zeros(count, *rows.shape[1:]) for name, rows in part.points().items()}
    )


def repoint(optimizer: Optimizer, successors: Mapping[Tensor, Tensor]) -> None:
    """Put new parameters at the places of old ones in the optimizer's groups."""
    for group in optimizer.param_groups:
        group["params"] = [successors.get(old, old) for old in group["params"]]


def _restarted(copied: Tensor, new: Tensor, growth: Growth) -> Tensor:
    """Which numbers of a parameter lose their moments."""
    fresh = growth.fresh.view(-1, *[1] * (new.ndim - 1))
    return (new != copied) | fresh


def _moved(value: Tensor, parameter: Tensor, growth: Growth, restarted: Tensor) -> Tensor:
    """A moment of the new parameter; what has no rows belongs to the parameter as a whole."""
    if value.shape == parameter.shape:
        return value[growth.source].masked_fill_(restarted, 0)
    if value.shape == parameter.shape[:1]:
        return value[growth.source].masked_fill_(growth.fresh, 0)
    return value
