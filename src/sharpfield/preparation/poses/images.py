"""Images that poses can be found from: as sharp as the capture allows, each at an instant."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8

from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import OptionError
from sharpfield.metrics.image import gradient_energy
from sharpfield.preparation.deblurring import deblur
from sharpfield.preparation.options import DeblurOptions, Source
from sharpfield.preparation.thresholds import Found

NEIGHBOURHOOD = 3
"""The sharpest of so many consecutive frames stands for them."""


@dataclass(frozen=True)
class Sharp:
    """Images, and the instants they show."""

    source: Literal["edi", "frames", "sharpest"]
    images: UInt8[np.ndarray, "n h w c"]
    """Display-referred."""
    frame: Int64[np.ndarray, "n"]
    """The frame of the capture that each one came from."""
    time_us: Int64[np.ndarray, "n"]
    found: Found | None = None
    """Thresholds, where events were used."""

    def __len__(self) -> int:
        """How many there are."""
        return len(self.images)

    def names(self) -> list[str]:
        """A file name for each, sorted as they are."""
        return [f"{i:06d}.png" for i in range(len(self))]


def sharp_images(capture: Capture, source: Source, *, instants: int = 1) -> Sharp:
    """Images of all frames, sorted by track and time.

    Args:
        capture: With frames; its poses are not looked at.
        source: `edi` takes blurred frames apart with their events. `frames` takes them as they
            are, at the middle of the exposure, and `sharpest` only the sharpest of its
            neighbours. `auto` is `edi` where there are events and exposures.
        instants: Images of each exposure; more than one only with `edi`.

    Raises:
        CaptureError: There are no frames, or no events where they are needed.
        OptionError: Several instants are asked of frames as they are.
    """
    frames = capture.needed_frames
    blurred = ~frames.exposure.instant
    if source == "auto":
        source = "edi" if capture.events is not None and blurred.any() else "frames"
    if source != "edi" and instants > 1:
        raise OptionError(
            "only events tell several instants of one exposure apart",
            got=f"{instants} instants from {source}",
            do="use --images edi, or 1 instant",
        )
    plain = np.flatnonzero(~blurred) if source == "edi" else np.arange(len(frames))
    made = Sharp(
        source,
        _display(frames.images[plain]),
        plain,
        frames.exposure.middle_us[plain],
    )
    if source == "edi":
        made = _joined(made, _taken_apart(capture, instants))
    order = np.lexsort((made.time_us, frames.track[made.frame]))
    if source == "sharpest":
        order = _sharpest(made, frames.track, order)
    return replace(
        made,
        images=made.images[order],
        frame=made.frame[order],
        time_us=made.time_us[order],
    )


def sharpness(images: UInt8[np.ndarray, "n h w c"]) -> Float[np.ndarray, "n"]:
    """Energy of the gradient of each image, for comparison with its neighbours."""
    return np.array([float(gradient_energy(torch.from_numpy(one / 255.0))) for one in images])


def _taken_apart(capture: Capture, instants: int) -> Sharp:
    every = Split(np.arange(len(capture.needed_frames)), np.zeros(0, np.int64))
    made = deblur(replace(capture, split=every), DeblurOptions(instants=instants))
    return Sharp(
        "edi",
        _display(made.images.reshape(-1, *made.images.shape[2:])),
        np.repeat(made.frame, instants),
        made.instants_us.reshape(-1),
        made.found,
    )


def _joined(plain: Sharp, deblurred: Sharp) -> Sharp:
    return replace(
        deblurred,
        images=np.concatenate([plain.images, deblurred.images]),
        frame=np.concatenate([plain.frame, deblurred.frame]),
        time_us=np.concatenate([plain.time_us, deblurred.time_us]),
    )


def _sharpest(
    made: Sharp, track: Int64[np.ndarray, "m"], order: Int64[np.ndarray, "n"]
) -> Int64[np.ndarray, "k"]:
    """Of each few consecutive images of one track, the sharpest."""
    energy = sharpness(made.images)
    kept = []
    for one in np.unique(track[made.frame]):
        own = order[track[made.frame[order]] == one]
        parts = np.array_split(own, -(-len(own) // NEIGHBOURHOOD))
        kept += [part[energy[part].argmax()] for part in parts]
    return np.array(kept, np.int64)


def _display(images: np.ndarray) -> UInt8[np.ndarray, "n h w c"]:
    """Eight bits of what was stored."""
    if images.dtype == np.uint8:
        return np.asarray(images)
    return np.rint(images * (255 / np.iinfo(images.dtype).max)).astype(np.uint8)
