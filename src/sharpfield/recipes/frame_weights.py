"""How much each frame of a walk is worth: sharp ones teach more than blurred ones.

A frame is compared with its neighbours in time, which see much the same; what differs between them
is blur.

Source: the content-aware weights of Hybrid Neural Rendering (CVPR 2023), here relative to the best
of a window; from events, blur is how many of them fell into the exposure.
"""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64

from sharpfield.core.capture import Capture
from sharpfield.metrics.sharpness import laplacian_variance

Quality = Literal["auto", "pictures", "events"]

WINDOW = 10
"""Frames that are compared with each other."""

LEAST = 0.05
"""Weight of the worst frame: even that sees something."""


def frame_weights(capture: Capture, quality: Quality) -> Float64[np.ndarray, "t"]:
    """A weight for each training frame, 1 for the best of its neighbourhood.

    Args:
        capture: With frames.
        quality: What tells; "auto" takes events where there are any.
    """
    if quality == "auto":
        quality = "pictures" if capture.events is None else "events"
    sharp = _by_events(capture) if quality == "events" else _by_pictures(capture)
    return np.maximum(_relative(sharp), LEAST)


def _by_pictures(capture: Capture) -> Float[np.ndarray, "t"]:
    frames = capture.needed_frames
    pictures = (torch.from_numpy(frames.images[i].astype(np.float32)) for i in capture.split.train)
    return np.array([float(laplacian_variance(p / frames.white)) for p in pictures])


def _by_events(capture: Capture) -> Float[np.ndarray, "t"]:
    """One over the events of each exposure: each is an edge that crossed a pixel meanwhile."""
    exposure, t_us = capture.needed_frames.exposure, capture.needed_events.t_us
    windows = np.array([exposure.window(int(i)) for i in capture.split.train])
    first, last = np.searchsorted(t_us, windows.T)
    return 1 / (1.0 + last - first)


def _relative(sharp: Float[np.ndarray, "t"]) -> Float64[np.ndarray, "t"]:
    """Each number over the largest around it."""
    half = WINDOW // 2
    most = [sharp[max(i - half, 0) : i + half + 1].max() for i in range(len(sharp))]
    return sharp / np.maximum(most, np.finfo(np.float64).tiny)
