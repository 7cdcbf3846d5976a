"""The optimizer of every recipe: Adam, one parameter group per `Group` of the model.

Source: Kingma and Ba, "Adam: a method for stochastic optimization" (ICLR 2015), with the authors'
constants.
"""

from collections.abc import Sequence

import torch
from torch import nn
from torch.optim import Optimizer

from sharpfield.core.protocols import Model
from sharpfield.core.schedule import Group
from sharpfield.training.row_adam import RowAdam

FUSED = ("cpu", "cuda")
"""Devices on which torch updates all parameters of a group in one kernel."""


def module_of(model: Model) -> nn.Module:
    """The model as the `nn.Module` that every model also is."""
    assert isinstance(model, nn.Module), f"{type(model).__name__} is not an nn.Module"
    return model


def device_of(model: Model) -> torch.device:
    """Where a model's parameters are."""
    return next(module_of(model).parameters()).device


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
