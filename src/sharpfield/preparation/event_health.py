"""Pixels of an event camera that do nothing, and pixels that never stop."""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import nn

from sharpfield.core.events import EventStream

AROUND = 7
"""Side of the neighbourhood a pixel is compared with."""
HOT_TIMES = 8.0
"""A hot pixel reports so many times as often as the median of its neighbourhood,"""
HOT_SIGMA = 8.0
"""and so many standard deviations (of counting) more."""
BUSY = 30.0
"""A silent pixel is dead where the median of its neighbourhood is at least so many events."""


def counts(events: EventStream) -> Int64[np.ndarray, "h w"]:
    """Events of each pixel; rectified positions count for the nearest."""
    x = np.clip(np.rint(events.x).astype(np.int64), 0, events.width - 1)
    y = np.clip(np.rint(events.y).astype(np.int64), 0, events.height - 1)
    flat = np.bincount(y * events.width + x, minlength=events.width * events.height)
    return flat.reshape(events.height, events.width)


def odd_pixels(
    count: Int64[np.ndarray, "h w"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Dead and hot pixels, by their counts of events."""
    usual = _median_around(count)
    hot = (count > HOT_TIMES * (usual + 1)) & (count > usual + HOT_SIGMA * np.sqrt(usual + 1))
    return (count == 0) & (usual >= BUSY), hot


def _median_around(count: Int64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    reach = AROUND // 2
    padded = nn.functional.pad(
        torch.from_numpy(count).double()[None, None], (reach,) * 4, mode="replicate"
    )
    windows = padded.unfold(2, AROUND, 1).unfold(3, AROUND, 1)
    return windows.flatten(-2).median(-1).values[0, 0].numpy()
