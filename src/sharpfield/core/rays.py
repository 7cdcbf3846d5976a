"""Rays through the scene, the radiance along them, and views: images of one pose and time."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.struct import Struct


@dataclass(frozen=True)
class Samples(Struct):
    """Points along rays, near to far, with the features of a field at them."""

    trailing: ClassVar = {"depth": 1, "feature": 2, "direction": 1}

    depth: Float[Tensor, "*b s"]
    """Ray parameter of each point, in the renderer's space."""
    feature: Float[Tensor, "*b s f"]
    """Hidden features of the fine head."""
    direction: Float[Tensor, "*b 3"]
    """Of the ray, in the renderer's space; not normalised: its length scales the depths."""


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
    """The rays' weights, carried along for `formation.mixing`."""
    coarse: "Radiance | None" = None
    """What the coarse head alone would give, where there are two."""
    samples: Samples | None = None
    """The points it was gathered from, if they were asked for."""


@dataclass(frozen=True)
class Rays(Struct):
    """Where light comes from, when, and how much it counts in its measurement.

    The rays that make one measurement lie along the last leading axis, `[..., k]`; their weights
    ride with them, so that one function (`formation.mixing`) can combine them for every sensor.
    """

    trailing: ClassVar = {"origin": 1, "direction": 1}

    origin: Float[Tensor, "*b 3"]
    direction: Float[Tensor, "*b 3"]
    """Unit length, world axes."""
    time: Float[Tensor, "*b"]
    """0...1 of the capture."""
    weight: Float[Tensor, "*b"]


@dataclass(frozen=True)
class Views(Struct):
    """Images of one camera, or the same part of each: where from, when, and how much they count.

    They are to whole images what `Rays` are to pixels: the views that make one measurement lie
    along the last leading axis, `[..., k]`, with their weights.
    """

    trailing: ClassVar = {"pose": 2, "corner": 1, "rows": 3}

    pose: Float[Tensor, "*b 3 4"]
    """World-from-camera; with a rolling shutter, of the middle row."""
    time: Float[Tensor, "*b"]
    """0...1 of the capture."""
    weight: Float[Tensor, "*b"]
    corner: Int64[Tensor, "*b 2"]
    """Pixel (x, y) at the upper left of the part."""
    size: tuple[int, int]
    """Width and height of the part."""
    rows: Float[Tensor, "*b q 3 4"] | None = None
    """With a rolling shutter: from the first row of the whole image to the last, evenly in time."""
