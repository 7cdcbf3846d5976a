"""Colour maps for depth, errors and events; all images are uint8 RGB, `[h w 3]`."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from sharpfield.core.events import EventStream
from sharpfield.events.image import splat_nearest

Rgb = UInt8[np.ndarray, "h w 3"]

ERROR_WHITE = 0.25
"""Mean absolute error over the channels from which on the colour is brightest."""

FULL_PERCENTILE = 90
"""Percentile of the absolute sums of polarities that gets the full colour."""
RED, BLUE, WHITE = (200, 32, 38), (38, 86, 190), (255, 255, 255)


def colour_depth(depth: Float[np.ndarray, "h w"]) -> Rgb:
    """Near is bright, far dark; linear in inverse depth from its 2nd to its 98th percentile."""
    inverse = 1 / np.maximum(depth, 1e-6)
    low, high = np.percentile(inverse, [2, 98])
    return _mapped((inverse - low) / max(high - low, 1e-12), cv2.COLORMAP_VIRIDIS)


def colour_error(predicted: Float[np.ndarray, "h w c"], truth: Float[np.ndarray, "h w c"]) -> Rgb:
    """Mean absolute error over the channels; black for zero, brightest from `ERROR_WHITE` on."""
    return _mapped(np.abs(predicted - truth).mean(-1) / ERROR_WHITE, cv2.COLORMAP_INFERNO)


def event_image(events: EventStream, start_us: int, end_us: int) -> Rgb:
    """Sum of the polarities in a time window on white: red where positive, blue where negative."""
    part = events.window(start_us, end_us)
    xy = np.stack([part.x, part.y], -1).astype(np.float32)
    sign = np.asarray(part.p, np.float64)[:, None]
    total = splat_nearest(xy, sign, width=events.width, height=events.height)  # [h, w, 1]
    active = np.abs(total[total != 0])
    full = np.percentile(active, FULL_PERCENTILE) if len(active) else 1.0
    return colour_signs(total[..., 0], full)


def colour_signs(total: Shaped[np.ndarray, "h w"], full: float) -> Rgb:
    """Signed values on white: red for positive, blue for negative ones.

    Args:
        total: Value of each pixel.
        full: Absolute value from which on the colour is full.
    """
    strength = np.clip(total / full, -1, 1)[..., None]
    colour = np.where(strength > 0, np.array(RED), np.array(BLUE))
    mixed = np.array(WHITE) + np.abs(strength) * (colour - np.array(WHITE))
    return mixed.round().astype(np.uint8)


def eight_bit(image: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """An image in 0...1 rounded to 8 bits."""
    return np.rint(image * 255).astype(np.uint8)


def _mapped(level: Shaped[np.ndarray, "h w"], colour_map: int) -> Rgb:
    """Values 0...1 in one of OpenCV's colour maps."""
    grey = (np.clip(level, 0, 1) * 255).round().astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, colour_map)[..., ::-1])


def as_display(image: Shaped[np.ndarray, "h w c"]) -> Float[Tensor, "h w c"]:
    """A stored image as float32, 0...1; integers are divided by their largest value."""
    if np.issubdtype(image.dtype, np.floating):
        return torch.from_numpy(image.astype(np.float32))
    return torch.from_numpy(image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max))


def stored_as_bytes(images: Shaped[np.ndarray, "*n h w c"]) -> UInt8[np.ndarray, "*n h w c"]:
    """Stored images, integers of any size, scaled to 8 bits."""
    if images.dtype == np.uint8:
        return np.asarray(images)
    return np.rint(images * (255.0 / np.iinfo(images.dtype).max)).astype(np.uint8)


def side_by_side(
    left: Rgb, right: Rgb, *, gap_px: int = 4, grey: int = 255
) -> UInt8[np.ndarray, "h total 3"]:
    """Two images of equal height with a gap between them."""
    gap = np.full((left.shape[0], gap_px, 3), grey, np.uint8)
    return np.concatenate([left, gap, right], 1)  # [h, w + gap + w, 3]
