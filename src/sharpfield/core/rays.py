"""Rays through the scene."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from sharpfield.core.struct import Struct


@dataclass(frozen=True)
class Rays(Struct):
    """Where light comes from, when, and how much it counts in its measurement.

    The rays that make one measurement lie along the last leading axis, `[..., k]`; their weights
    ride with them, so that one function (`formation.mix`) can combine them for every sensor.
    """

    trailing: ClassVar = {"origin": 1, "direction": 1}

    origin: Float[Tensor, "*b 3"]
    direction: Float[Tensor, "*b 3"]
    """Unit length, world axes."""
    time: Float[Tensor, "*b"]
    """0...1 of the capture."""
    weight: Float[Tensor, "*b"]
