"""What renders are compared with: sharp truth where it is known, else the stored image.

A *held-out* frame is compared with its truth if the capture knows it, or with its own image. That
image is sharp when it was taken in one instant; when it was exposed for a while it is blurred, and
the reference says so, since a sharp render is then punished for being sharp.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.frames import Frames
from sharpfield.core.selection import evenly_spread

TRUTH, SHARP, BLURRED = "truth", "sharp image", "blurred image"

UNSCORED = 3
"""Training views without truth that are rendered all the same, to look at."""


@dataclass(frozen=True)
class Reference:
    """A frame, and the picture a render from its mid-exposure pose should look like."""

    frame: int
    name: str
    kind: str
    """`truth`, `sharp image`, `blurred image`, or "" where there is nothing to compare with."""
    image: Float[Tensor, "h w c"] | None
    """Display domain, 0...1."""
    measured: Float[Tensor, "h w c"]
    """What the camera recorded, display domain, 0...1."""


def held_out(capture: Capture) -> list[Reference]:
    """References of the frames that were not trained on, in the order of the split."""
    if capture.frames is None:
        return []
    return [_reference(capture.frames, int(i), own_image=True) for i in capture.split.test]


def trained_on(capture: Capture, *, limit: int | None = None) -> list[Reference]:
    """References of training frames whose sharp truth is known; if none is, a few without one.

    Args:
        capture: With or without frames.
        limit: Most frames to return, evenly spread; None for all.
    """
    frames = capture.frames
    if frames is None:
        return []
    chosen = capture.split.train[frames.with_truth[capture.split.train]]
    if len(chosen):
        chosen = evenly_spread(chosen, len(chosen) if limit is None else limit)
    else:
        chosen = evenly_spread(
            capture.split.train, UNSCORED if limit is None else min(limit, UNSCORED)
        )
    return [_reference(frames, int(i), own_image=False) for i in chosen]


def as_display(image: Shaped[np.ndarray, "h w c"]) -> Float[Tensor, "h w c"]:
    """A stored image as float32, 0...1; float images are that already."""
    if np.issubdtype(image.dtype, np.floating):
        return torch.from_numpy(image.astype(np.float32))
    return torch.from_numpy(image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max))


def _reference(frames: Frames, i: int, *, own_image: bool) -> Reference:
    measured = as_display(frames.images[i])
    if frames.truth is not None and frames.with_truth[i]:
        return Reference(i, frames.names[i], TRUTH, as_display(frames.truth[i]), measured)
    if not own_image:
        return Reference(i, frames.names[i], "", None, measured)
    kind = SHARP if frames.exposure.instant[i] else BLURRED
    return Reference(i, frames.names[i], kind, measured, measured)
