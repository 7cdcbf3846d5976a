"""Small patches of frames, drawn as pure functions of the seed and the step.

A *patch* is p by p pixels with a spacing of `apart` pixels: with a wide spacing, a kernel of few
pixels on the patch represents a long blur in the image. Patches of one pixel are pixels.

Source: Hybrid Neural Rendering (CVPR 2023), whose patches are 8x8, 1 to 8 pixels apart.
"""

from dataclasses import dataclass

import numpy as np
import torch

from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import Pixels
from sharpfield.core.seed import number, numpy_generator
from sharpfield.ops.permutation import shuffled
from sharpfield.sampling.pixels_and_pairs import PIXEL_CENTRE, PixelTable


@dataclass(frozen=True)
class PatchShape:
    """Size of patches, their spacing, and the border they keep off."""

    side: int = 8
    """Pixels along each edge."""
    apart: tuple[int, int] = (1, 8)
    """Smallest and largest spacing in pixels, drawn for each patch."""
    border: int = 10
    """Pixels at the edge of an image that are not used."""


def draw_patches(
    table: PixelTable, count: int, shape: PatchShape, *, frames: int, seed: int, step: int
) -> Pixels:
    """Patches `[count, side, side]` of a few frames, an equal number of each.

    Frames are drawn without replacement, in a shuffled order.

    Args:
        table: The pixels to draw from.
        count: Number of patches.
        shape: Of each.
        frames: Number of frames in one step.
        seed: The run's seed.
        step: The training step.

    Raises:
        OptionError: The patches are larger than the images.
    """
    height, width = table.images.shape[1:3]
    apart = min(
        shape.apart[1], (min(height, width) - 2 * shape.border - 1) // max(shape.side - 1, 1)
    )
    if apart < 1 or min(height, width) <= 2 * shape.border:
        raise OptionError(
            "images are too small for such patches",
            got=f"{width}x{height} px, borders of {shape.border} px, {shape.side} pixels a side",
            do="take smaller patches or a narrower border",
        )
    random = numpy_generator(seed, step, "patches")
    frames = min(frames, len(table.frame))
    epoch, round_ = divmod(step, len(table.frame) // frames)
    rank = np.arange(round_ * frames, (round_ + 1) * frames, dtype=np.int64)
    order = shuffled(rank, len(table.frame), seed=number(seed, 0, "frames"), epoch=epoch)
    frame = table.frame[order[np.arange(count) * frames // count]]
    step_px = random.integers(min(shape.apart[0], apart), apart + 1, size=count)
    reach = step_px * (shape.side - 1)
    left = shape.border + (random.random(count) * (width - 2 * shape.border - reach)).astype(int)
    top = shape.border + (random.random(count) * (height - 2 * shape.border - reach)).astype(int)
    offset = np.arange(shape.side) * step_px[:, None]  # [count, side]
    row = np.broadcast_to((top[:, None] + offset)[:, :, None], (count, shape.side, shape.side))
    column = np.broadcast_to((left[:, None] + offset)[:, None], row.shape)
    which = np.broadcast_to(frame[:, None, None], row.shape)
    value = table.images[which, row, column].astype(np.float32) / np.float32(table.white)
    xy = np.stack([column, row], -1).astype(np.float32) + np.float32(PIXEL_CENTRE)
    open_close = torch.from_numpy(table.time[which])
    return Pixels(
        xy=torch.from_numpy(xy),
        frame=torch.from_numpy(which.copy()),
        track=torch.from_numpy(table.track[which]),
        open=open_close[..., 0],
        close=open_close[..., 1],
        value=torch.from_numpy(value),
    )
