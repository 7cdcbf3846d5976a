"""Light gathered along rays, and the points it was gathered from."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from sharpfield.core.struct import Struct


@dataclass(frozen=True)
class Samples(Struct):
    """Points along rays, near to far, with what a field found there."""

    trailing: ClassVar = {"depth": 1, "feature": 2, "direction": 1}

    depth: Float[Tensor, "*b s"]
    """Ray parameter of each point, in the renderer's space."""
    feature: Float[Tensor, "*b s f"]
    """Hidden features of the fine head."""
    direction: Float[Tensor, "*b 3"]
    """Of the ray, in the renderer's space; its length matters."""


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
    """What the coarse head alone would give, where there are two."""
    samples: Samples | None = None
    """The points it was gathered from, if they were asked for."""
