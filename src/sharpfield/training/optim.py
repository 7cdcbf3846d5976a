"""The optimizer of every recipe: Adam, one parameter group per `Group` of the model.

Source: Kingma and Ba, "Adam: a method for stochastic optimization" (ICLR 2015), with the authors'
constants.

Where a gradient is sparse, each row has its own step count: moments and bias correction of a row
are updated only in steps whose gradient has that row, and other rows cost nothing. (Dense Adam
would keep moving all rows along their momentum.) Dense gradients go to PyTorch's Adam, unchanged.

When points are added, pruned or relocated, Adam's moments follow the rows they belong to. They
restart at zero for fresh points and for values that differ from their source row. State of a
parameter as a whole (its step count) is kept.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from sharpfield.core.protocols import Growth, Model, PointSet
from sharpfield.core.schedule import Group

ROW_STEPS = "row_steps"
"""Optimizer state: for each row, the number of steps that updated it."""


class RowAdam(Adam):
    """Adam that updates only the rows of sparse gradients."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Update all parameters that have gradients."""
        assert closure is None, "losses are computed before, micro-batch by micro-batch"
        sparse: list[tuple[Tensor, Tensor]] = []
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None and parameter.grad.is_sparse:
                    sparse.append((parameter, parameter.grad))
                    self._move(parameter, parameter.grad.coalesce(), group)
                    parameter.grad = None  # Adam below takes only dense gradients
        super().step()
        for parameter, gradient in sparse:
            parameter.grad = gradient

    def _move(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        """Adam on the rows of a sparse gradient."""
        state = self.state[parameter]
        if not state:
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
            state[ROW_STEPS] = torch.zeros(len(parameter), device=parameter.device)
        rows, slope = gradient.indices()[0], gradient.values()
        first, second = group["betas"]
        taken = state[ROW_STEPS][rows] + 1
        mean = first * state["exp_avg"][rows] + (1 - first) * slope
        square = second * state["exp_avg_sq"][rows] + (1 - second) * slope.square()
        state[ROW_STEPS][rows] = taken
        state["exp_avg"][rows] = mean
        state["exp_avg_sq"][rows] = square
        count = taken.view(-1, *[1] * (slope.ndim - 1))
        mean = mean / _bias_correction(first, count)
        size = (square / _bias_correction(second, count)).sqrt() + group["eps"]
        parameter.index_add_(0, rows, mean / size, alpha=-group["lr"])


def _bias_correction(decay: float, count: Tensor) -> Tensor:
    """Bias correction 1 - decay^count of a moment that starts at zero (section 3)."""
    return -torch.expm1(count * math.log(decay))


FUSED = ("cpu", "cuda")
"""Devices on which torch updates all parameters of a group in one kernel."""


def module_of(model: Model) -> nn.Module:
    """The model as an `nn.Module`, which every model is."""
    assert isinstance(model, nn.Module), f"{type(model).__name__} is not an nn.Module"
    return model


def adam(model: Model) -> RowAdam:
    """Adam over the model's parameter groups, with the learning rates of step 0.

    A trainable parameter in no group would silently never be trained: that is an error.
    """
    groups = model.groups()
    grouped = {id(parameter) for group in groups for parameter in group.parameters}
    ungrouped = [
        name
        for name, parameter in module_of(model).named_parameters()
        if parameter.requires_grad and id(parameter) not in grouped
    ]
    assert not ungrouped, f"parameters of no group: {', '.join(ungrouped)}"
    parameters = [parameter for group in groups for parameter in group.parameters]
    fused = all(
        parameter.device.type in FUSED and torch.is_floating_point(parameter)
        for parameter in parameters
    )
    described = [
        {"params": list(group.parameters), "lr": group.rate(0), "name": group.name}
        for group in groups
        if group.parameters
    ]
    return RowAdam(described, betas=(0.9, 0.999), eps=1e-8, fused=fused)


def set_rates(optimizer: Optimizer, groups: Sequence[Group], step: int) -> None:
    """Give each parameter group of the optimizer the learning rate its schedule has at `step`."""
    rates = {group.name: group.rate(step) for group in groups}
    for described in optimizer.param_groups:
        described["lr"] = rates[described["name"]]


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
        restarted = {  # values that differ from their source row, and all of fresh points
            name: (new[name] != rows) | growth.fresh.view(-1, *[1] * (rows.ndim - 1))
            for name, rows in copied.items()
        }
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


def _moved(value: Tensor, parameter: Tensor, growth: Growth, restarted: Tensor) -> Tensor:
    """Optimizer state of the new parameter; state without rows belongs to all of it."""
    if value.shape == parameter.shape:
        return value[growth.source].masked_fill_(restarted, 0)
    if value.shape == parameter.shape[:1]:
        return value[growth.source].masked_fill_(growth.fresh, 0)
    return value
