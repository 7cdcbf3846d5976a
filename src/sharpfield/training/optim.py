"""The optimizer of every recipe: Adam, one parameter group per `Group` of the model.

Source: Kingma and Ba, "Adam: a method for stochastic optimization" (ICLR 2015), with the authors'
constants.

Adam for tables of which a step touches few rows.

Where a gradient is sparse, each row is treated as if it had an optimizer of its own, which is asked
only in steps that the row takes part in: its moments, and the correction for their beginning at
zero, follow its own count of steps. Rows that take no part cost nothing. Dense gradients go to
PyTorch's Adam, unchanged.

Source: Kingma and Ba, "Adam: a method for stochastic optimization" (ICLR 2015), section 2. Dense
Adam would go on moving rows that take no part along their momentum.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from sharpfield.core.protocols import Model
from sharpfield.core.schedule import Group

TAKEN = "taken"
"""The state that counts, for each row, the steps it took part in."""


class RowAdam(Adam):
    """Adam that leaves rows without a gradient alone, where gradients are sparse."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """One step of all parameters that have gradients."""
        assert closure is None, "losses are worked out before, part by part"
        sparse: list[tuple[Tensor, Tensor]] = []
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None and parameter.grad.is_sparse:
                    sparse.append((parameter, parameter.grad))
                    self._move(parameter, parameter.grad.coalesce(), group)
                    parameter.grad = None  # hidden from Adam, which knows dense ones only
        super().step()
        for parameter, gradient in sparse:
            parameter.grad = gradient

    def _move(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        """Adam on the rows that the gradient has."""
        state = self.state[parameter]
        if not state:
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
            state[TAKEN] = torch.zeros(len(parameter), device=parameter.device)
        rows, slope = gradient.indices()[0], gradient.values()
        first, second = group["betas"]
        taken = state[TAKEN][rows] + 1
        mean = first * state["exp_avg"][rows] + (1 - first) * slope
        square = second * state["exp_avg_sq"][rows] + (1 - second) * slope.square()
        state[TAKEN][rows] = taken
        state["exp_avg"][rows] = mean
        state["exp_avg_sq"][rows] = square
        count = taken.view(-1, *[1] * (slope.ndim - 1))
        mean = mean / _begun(first, count)
        size = (square / _begun(second, count)).sqrt() + group["eps"]
        parameter.index_add_(0, rows, mean / size, alpha=-group["lr"])


def _begun(decay: float, count: Tensor) -> Tensor:
    """1 - decay^count: what an average that began at zero holds of what it should."""
    return -torch.expm1(count * math.log(decay))


FUSED = ("cpu", "cuda")
"""Devices on which torch updates all parameters of a group in one kernel."""


def module_of(model: Model) -> nn.Module:
    """The model as the `nn.Module` that every model also is."""
    assert isinstance(model, nn.Module), f"{type(model).__name__} is not an nn.Module"
    return model


def adam(model: Model) -> RowAdam:
    """Adam over the model's groups, with the rates of step 0.

    A parameter that wants gradients and belongs to no group would silently never move; that is an
    error in the model.
    """
    groups = model.groups()
    grouped = {id(parameter) for group in groups for parameter in group.parameters}
    forgotten = [
        name
        for name, parameter in module_of(model).named_parameters()
        if parameter.requires_grad and id(parameter) not in grouped
    ]
    assert not forgotten, f"parameters of no group: {', '.join(forgotten)}"
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
