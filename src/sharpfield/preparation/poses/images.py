"""Input images of structure from motion: as sharp as possible, each at one instant."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8

from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import OptionError
from sharpfield.metrics.image import gradient_energy
from sharpfield.preparation.deblurring import deblur_frames
from sharpfield.preparation.options import DeblurOptions, ImageSource
from sharpfield.preparation.thresholds import FoundThresholds
from sharpfield.report.colormaps import stored_as_bytes

NEIGHBOURHOOD = 3
"""`sharpest` takes one of so many consecutive frames."""


@dataclass(frozen=True)
class SfmImages:
    """Images of one camera, each at one instant."""

    source: Literal["edi", "frames", "sharpest"]
    images: UInt8[np.ndarray, "n h w c"]
    """Display domain."""
    frame: Int64[np.ndarray, "n"]
    """Index of the frame of the capture that each image comes from."""
    time_us: Int64[np.ndarray, "n"]
    """Instant of each image."""
    found: FoundThresholds | None = None
    """Thresholds, if events were used."""

    def __len__(self) -> int:
        """Number of images."""
        return len(self.images)

    def names(self) -> list[str]:
        """File names in the order of the images."""
        return [f"{i:06d}.png" for i in range(len(self))]


def sfm_images(capture: Capture, source: ImageSource, *, instants: int = 1) -> SfmImages:
    """Images of all frames, sorted by track and time.

    Args:
        capture: With frames; its poses are not used.
        source: `edi` deblurs frames with their events. `frames` takes them as recorded, at the
            middle of the exposure; `sharpest` takes only the sharpest of a few neighbours. `auto`
            is `edi` where there are events and exposures.
        instants: Images of each exposure; more than one only with `edi`.

    Raises:
        CaptureError: There are no frames, or no events where they are needed.
        OptionError: Several instants without events.
    """
    frames = capture.needed_frames
    blurred = ~frames.exposure.instant
    if source == "auto":
        source = "edi" if capture.events is not None and blurred.any() else "frames"
    if source != "edi" and instants > 1:
        raise OptionError(
            "several instants of one exposure need events",
            got=f"{instants} instants from {source}",
            do="use --images edi, or 1 instant",
        )
    plain = np.flatnonzero(~blurred) if source == "edi" else np.arange(len(frames))
    made = SfmImages(
        source, stored_as_bytes(frames.images[plain]), plain, frames.exposure.middle_us[plain]
    )
    if source == "edi":
        made = _joined(made, _deblurred(capture, instants))
    order = np.lexsort((made.time_us, frames.track[made.frame]))
    if source == "sharpest":
        order = _sharpest(made, frames.track, order)
    return replace(
        made, images=made.images[order], frame=made.frame[order], time_us=made.time_us[order]
    )


def sharpness(images: UInt8[np.ndarray, "n h w c"]) -> Float[np.ndarray, "n"]:
    """Gradient energy of each image, to compare it with its neighbours."""
    return np.array([float(gradient_energy(torch.from_numpy(one / 255.0))) for one in images])


def _deblurred(capture: Capture, instants: int) -> SfmImages:
    every = Split(np.arange(len(capture.needed_frames)), np.zeros(0, np.int64))
    made = deblur_frames(replace(capture, split=every), DeblurOptions(instants=instants))
    return SfmImages(
        "edi",
        stored_as_bytes(made.images.reshape(-1, *made.images.shape[2:])),
        np.repeat(made.frame, instants),
        made.instants_us.reshape(-1),
        made.found,
    )


def _joined(plain: SfmImages, deblurred: SfmImages) -> SfmImages:
    return replace(
        deblurred,
        images=np.concatenate([plain.images, deblurred.images]),
        frame=np.concatenate([plain.frame, deblurred.frame]),
        time_us=np.concatenate([plain.time_us, deblurred.time_us]),
    )


def _sharpest(
    made: SfmImages, track: Int64[np.ndarray, "m"], order: Int64[np.ndarray, "n"]
) -> Int64[np.ndarray, "k"]:
    """Indices of the sharpest of each few consecutive images of one track."""
    energy = sharpness(made.images)
    kept = []
    for one in np.unique(track[made.frame]):
        own = order[track[made.frame[order]] == one]
        parts = np.array_split(own, -(-len(own) // NEIGHBOURHOOD))
        kept += [part[energy[part].argmax()] for part in parts]
    return np.array(kept, np.int64)
