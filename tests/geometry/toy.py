"""Poses at random, from a generator of their own."""

import torch
from torch import Tensor

from sharpfield.core.seed import generator
from sharpfield.geometry import se3


def twists(*shape: int, turn: float = 2.0, stream: str = "twists") -> Tensor:
    """Float64 twists whose rotations are up to `turn` rad about each axis."""
    made = generator(0, 0, stream)
    unit = 2 * torch.rand(*shape, 6, generator=made, dtype=torch.float64) - 1
    return unit * torch.tensor([turn] * 3 + [3.0] * 3, dtype=torch.float64)


def poses(*shape: int, turn: float = 1.5, stream: str = "poses") -> Tensor:
    """Float64 poses anywhere."""
    return se3.exp(twists(*shape, turn=turn, stream=stream))


def points(*shape: int) -> Tensor:
    """Float64 points."""
    return torch.randn(*shape, 3, generator=generator(0, 0, "points"), dtype=torch.float64)
