"""Deblur the frames of a capture with its events alone: the event double integral, frame by frame.

No scene is learned. It is the quickest look at what the events of a capture know, and a check of
thresholds, clocks and pixel grids: where these are wrong, the pictures get worse, not better.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64, Shaped
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.formation.edi import FLOOR, joint_latents, latent, published
from sharpfield.formation.event_motion import EventMotion
from sharpfield.formation.threshold import FixedThresholds
from sharpfield.formation.tone import tone_of
from sharpfield.metrics.sharpness import luma
from sharpfield.preparation.thresholds import (
    Found,
    find_thresholds,
    known_thresholds,
    linear_light,
)

Method = Literal["exact", "joint", "published"]


@dataclass(frozen=True)
class DeblurOptions:
    """How frames are deblurred."""

    threshold: float | Literal["known", "find"] = "known"
    """Contrast threshold of both signs. `known` takes what the capture's source says and finds
    thresholds where it is silent; `find` finds them in any case."""
    method: Method = "exact"
    """`exact`: in linear light, integrated from event to event. `joint`: the same, then all frames
    made to agree with the events between them. `published`: as the released Ev-DeblurNeRF does it,
    on stored values with eight slices."""
    instants: int = 1
    """Pictures per exposure, in the middles of as many equal parts of it. Only for `exact`."""

    def __post_init__(self) -> None:
        if self.instants < 1 or (self.instants > 1 and self.method != "exact"):
            raise OptionError(
                "only the exact method gives several pictures per exposure",
                got=f"{self.instants} with method {self.method}",
                do="use method `exact`, or 1 instant",
            )


@dataclass(frozen=True)
class Deblurred:
    """Sharp pictures of the frames of a capture, as the frames are stored."""

    pictures: Shaped[np.ndarray, "n k h w c"]
    """One per instant of each exposure."""
    frame: Int64[np.ndarray, "n"]
    """Index of each one's frame in the capture."""
    instants_us: Int64[np.ndarray, "n k"]
    found: Found


def deblur(capture: Capture, options: DeblurOptions) -> Deblurred:
    """Sharp pictures of the frames to learn from; of all blurred frames if none are named.

    Raises:
        CaptureError: Frames or events are missing, or no frame is blurred.
    """
    held = capture.needed_frames
    chosen = capture.split.train if len(capture.split.train) else np.arange(len(held))
    chosen = chosen[~held.exposure.instant[chosen]]
    if not len(chosen):
        raise CaptureError(
            "no frame to deblur has an exposure", where=capture.name, do="give exposure times"
        )
    chosen = chosen[np.argsort(held.exposure.open_us[chosen], kind="stable")]
    motion = EventMotion.of(capture)
    found = _thresholds(capture, motion, options)
    opens, length = held.exposure.open_us[chosen], held.exposure.duration_us[chosen]
    parts = (np.arange(options.instants) + 0.5) / options.instants
    instants = opens[:, None] + np.rint(length[:, None] * parts).astype(np.int64)
    if options.method == "joint":
        pictures = _joint(capture, motion, chosen, instants[:, 0], found.thresholds)
    elif options.method == "published":
        pictures = np.stack([_published(capture, int(i), found.thresholds) for i in chosen])
    else:
        pictures = np.stack(
            [
                _exact(capture, motion, int(i), when, found.thresholds)
                for i, when in zip(chosen, instants, strict=True)
            ]
        )
    return Deblurred(pictures, chosen, instants, found)


def _thresholds(capture: Capture, motion: EventMotion, options: DeblurOptions) -> Found:
    if not isinstance(options.threshold, str):
        return Found(FixedThresholds(options.threshold, options.threshold), "given")
    known = known_thresholds(capture) if options.threshold == "known" else None
    return find_thresholds(capture, motion) if known is None else Found(known, "known")


def _exact(
    capture: Capture,
    motion: EventMotion,
    frame: int,
    instants_us: Int64[np.ndarray, "k"],
    thresholds: FixedThresholds,
) -> Shaped[np.ndarray, "k h w c"]:
    tone = tone_of(capture.needed_frames.encoding)
    light = linear_light(capture, frame, tone)
    path = motion.path(capture.needed_frames.exposure.window(frame), instants_us, thresholds)
    sharp = torch.stack([latent(light, path, k) for k in range(len(instants_us))])
    return _stored(capture, tone.encode(sharp.clamp(0, 1)))


def _published(
    capture: Capture, frame: int, thresholds: FixedThresholds
) -> Shaped[np.ndarray, "1 h w c"]:
    held = capture.needed_frames
    stored = torch.from_numpy(np.asarray(held.images[frame], np.float32)) / held.white
    window = capture.needed_frames.exposure.window(frame)
    return _stored(capture, published(stored, capture.needed_events, window, thresholds)[None])


def _joint(
    capture: Capture,
    motion: EventMotion,
    frames: Int64[np.ndarray, "n"],
    middles_us: Int64[np.ndarray, "n"],
    thresholds: FixedThresholds,
) -> Shaped[np.ndarray, "n 1 h w c"]:
    """The events of a mono sensor tell of luma; each colour then follows the luma of its pixel."""
    tone = tone_of(capture.needed_frames.encoding)
    sharp = []
    for frame, middle in zip(frames, middles_us, strict=True):
        path = motion.path(
            capture.needed_frames.exposure.window(int(frame)), np.array([middle]), thresholds
        )
        sharp.append(latent(linear_light(capture, int(frame), tone), path, 0))
    sharp = torch.stack(sharp)
    told = sharp if motion.channel is not None else luma(sharp)[..., None]
    gaps = [
        motion.between(int(start), int(end), thresholds)
        for start, end in zip(middles_us[:-1], middles_us[1:], strict=True)
    ]
    alone = (told + FLOOR).log()
    agreed = joint_latents(alone, torch.stack(gaps)) if gaps else alone
    made = tone.encode((sharp * (agreed - alone).exp()).clamp(0, 1))
    return _stored(capture, made)[:, None]


def _stored(capture: Capture, picture: Float[Tensor, "*n h w c"]) -> Shaped[np.ndarray, "*n h w c"]:
    """Rounded to the frames' own type."""
    frames = capture.needed_frames
    return np.rint(picture.clamp(0, 1).numpy() * frames.white).astype(frames.images.dtype)
