"""The device of tensors and models."""

from itertools import chain

import torch
from torch import nn


def device_of(part: object) -> torch.device:
    """The device of a module's tensors; the CPU if it is no module, or has none."""
    if not isinstance(part, nn.Module):
        return torch.device("cpu")
    held = next(chain(part.parameters(), part.buffers()), None)
    return torch.device("cpu") if held is None else held.device
