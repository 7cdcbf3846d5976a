"""Which device tensors and models are on."""

from itertools import chain

import torch
from torch import nn


def device_of(part: object) -> torch.device:
    """Where a module's tensors are; the CPU if it is no module, or holds none."""
    if not isinstance(part, nn.Module):
        return torch.device("cpu")
    held = next(chain(part.parameters(), part.buffers()), None)
    return torch.device("cpu") if held is None else held.device
