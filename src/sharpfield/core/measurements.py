"""Training batches as tensors: pixels, pairs of events, views and their measured depths."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.struct import Struct


@dataclass(frozen=True)
class Pixels(Struct):
    """Pixels of frames, with what the camera reported there."""

    trailing: ClassVar = {"xy": 1, "value": 1}

    xy: Float[Tensor, "*b 2"]
    """Centres, in pixels."""
    frame: Int64[Tensor, "*b"]
    """Index of the frame in the capture."""
    track: Int64[Tensor, "*b"]
    open: Float[Tensor, "*b"]
    """When the shutter opened, 0...1 of the capture."""
    close: Float[Tensor, "*b"]
    value: Float[Tensor, "*b c"]
    """As stored, 0...1: display-referred unless the frames are linear."""

    @property
    def middle(self) -> Float[Tensor, "*b"]:
        """Middle of the exposure."""
        return (self.open + self.close) / 2


@dataclass(frozen=True)
class EventPairs(Struct):
    """Two instants of the same pixel, and the events counted after the first up to the second."""

    trailing: ClassVar = {"xy": 1}

    xy: Float[Tensor, "*b 2"]
    """Position of the pixel, in pixels (centres at +0.5)."""
    track: Int64[Tensor, "*b"]
    start: Float[Tensor, "*b"]
    """First instant, 0...1 of the capture."""
    end: Float[Tensor, "*b"]
    negative: Float[Tensor, "*b"]
    """Minus the number of OFF events: 0, -1, ...; fractional where the phase is known."""
    positive: Float[Tensor, "*b"]
    """Number of ON events."""
    channel: Int64[Tensor, "*b"] | None = None
    """Colour filter of the pixel: 0 red, 1 green, 2 blue. None on a mono sensor."""
    slack: Float[Tensor, "*b"] | None = None
    """Possible error of the counts, in events, since they are whole numbers. None for pairs that
    begin and end with an event, where they are exact."""

    def measured(
        self, threshold_negative: Tensor | float, threshold_positive: Tensor | float
    ) -> Float[Tensor, "*b"]:
        """Change of log intensity that the events report, given the contrast thresholds."""
        return self.negative * threshold_negative + self.positive * threshold_positive


@dataclass(frozen=True)
class Instants(Struct):
    """When whole images are looked at: the k instants of each look lie along the last axis."""

    trailing: ClassVar = {"corner": 1}

    time: Float[Tensor, "*b"]
    """0...1 of the capture, ascending."""
    track: Int64[Tensor, "*b"]
    weight: Float[Tensor, "*b"]
    """Of each instant in the exposure of the look; 0 for those outside."""
    corner: Int64[Tensor, "*b 2"]
    """Pixel (x, y) at the upper left of the part of the image that is looked at."""
    size: tuple[int, int]
    """Width and height of the part."""


@dataclass(frozen=True)
class Depths(Struct):
    """What a depth camera measured of the pixels of a look."""

    value: Float[Tensor, "*b"]
    """Along the camera's axis, in units of the scene; 0 where nothing was measured."""
    instant: Int64[Tensor, "*b"]
    """At which of the instants of the look it was measured."""


Batch = dict[str, Pixels | EventPairs | Instants | Depths]
"""What a recipe draws for a step, by name."""

Terms = dict[str, Tensor]
"""The terms of a loss, by name."""
