"""Whole images asked for at once: grids of rays that share a pose and a time."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.struct import Struct


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
