"""Light: what a field emits at points, and what gathering it along rays gives."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from sharpfield.core.struct import Struct


@dataclass(frozen=True)
class Emission(Struct):
    """What a field returns at points along rays."""

    trailing: ClassVar = {"rgb": 1}

    density: Float[Tensor, "*b"]
    """Before any activation, so that a renderer may add noise first."""
    rgb: Float[Tensor, "*b c"]
    """Linear, 0...1."""


@dataclass(frozen=True)
class Radiance(Struct):
    """Light gathered along rays."""

    trailing: ClassVar = {"rgb": 1}

    rgb: Float[Tensor, "*b c"]
    """Linear."""
    depth: Float[Tensor, "*b"]
    """Expected distance along the ray, in the renderer's own space (see its documentation)."""
    opacity: Float[Tensor, "*b"]
    """How much of the light was stopped by the scene, 0...1."""
    weight: Float[Tensor, "*b"]
    """The rays' weights, carried along for `formation.mix`."""
    coarse: "Radiance | None" = None
    """What the coarse field alone would give, where there are two."""
