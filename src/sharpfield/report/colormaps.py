"""Numbers as colours: depth, errors, events. All images are uint8 RGB, `[h w 3]`."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from sharpfield.core.events import EventStream
from sharpfield.events.image import splat_nearest

Colours = UInt8[np.ndarray, "h w 3"]

ERROR_WHITE = 0.25
"""Mean absolute error over the channels that gets the brightest colour."""

FULL = 90
RED, BLUE, WHITE = (200, 32, 38), (38, 86, 190), (255, 255, 255)


def colour_depth(depth: Float[np.ndarray, "h w"]) -> Colours:
    """Near bright, far dark, evenly in inverse depth between its 2nd and 98th percentile."""
    inverse = 1 / np.maximum(depth, 1e-6)
    low, high = np.percentile(inverse, [2, 98])
    return _mapped((inverse - low) / max(high - low, 1e-12), cv2.COLORMAP_VIRIDIS)


def colour_error(
    predicted: Float[np.ndarray, "h w c"], truth: Float[np.ndarray, "h w c"]
) -> Colours:
    """Mean absolute error over the channels; black for none, bright from `ERROR_WHITE` on."""
    return _mapped(np.abs(predicted - truth).mean(-1) / ERROR_WHITE, cv2.COLORMAP_INFERNO)


def event_image(events: EventStream, start_us: int, end_us: int) -> Colours:
    """Events of a time window on white: red where more got brighter, blue where more got darker.

    The colour is full where the sum of signs reaches its 90th percentile.
    """
    part = events.window(start_us, end_us)
    xy = np.stack([part.x, part.y], -1).astype(np.float32)
    sign = np.asarray(part.p, np.float64)[:, None]
    total = splat_nearest(xy, sign, width=events.width, height=events.height)
    busy = np.abs(total[total != 0])
    return colour_signs(total[..., 0], np.percentile(busy, FULL) if len(busy) else 1.0)


def colour_signs(total: Shaped[np.ndarray, "h w"], full: float) -> Colours:
    """Sums of signs on white, red for positive and blue for negative ones.

    Args:
        total: At each pixel.
        full: The sum that gets the full colour.
    """
    strength = np.clip(total / full, -1, 1)[..., None]
    colour = np.where(strength > 0, np.array(RED), np.array(BLUE))
    mixed = np.array(WHITE) + np.abs(strength) * (colour - np.array(WHITE))
    return mixed.round().astype(np.uint8)


def eight_bit(image: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """A image in 0...1 rounded to 8 bit."""
    return np.rint(image * 255).astype(np.uint8)


def _mapped(level: Shaped[np.ndarray, "h w"], colours: int) -> Colours:
    """A level 0...1 through one of OpenCV's colour maps."""
    grey = (np.clip(level, 0, 1) * 255).round().astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, colours)[..., ::-1])


def as_display(image: Shaped[np.ndarray, "h w c"]) -> Float[Tensor, "h w c"]:
    """A stored image as float32, 0...1; float images are that already."""
    if np.issubdtype(image.dtype, np.floating):
        return torch.from_numpy(image.astype(np.float32))
    return torch.from_numpy(image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max))
