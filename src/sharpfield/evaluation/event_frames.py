"""Event frames: how many events each pixel reported in each window of a stream.

A folder of them holds

    counts.npy      int32 [n h w 2]: darker and brighter, all that happened
    frames.npy      int32 [n h w]: brighter minus darker, without few events if that is asked
    0000.png ...    the same as pictures: red brighter, blue darker, one scale for all
    frames.mp4      the pictures one after another

Source: EvDNeRF (WACV 2024), whose figures leave out pixels with few events (`without_few`).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.evaluation.pictures import FULL, colour_signs
from sharpfield.evaluation.video import write_film
from sharpfield.ops.event_image import splat_nearest
from sharpfield.storage.images import write_image

COUNTS, FRAMES, FILM = "counts.npy", "frames.npy", "frames.mp4"

PUBLISHED_SHARE = 0.3
"""Least share of a frame's largest count that the published figures show."""

RATE = 20.0
"""Windows per second of the film."""


def count_events(events: EventStream) -> Int32[np.ndarray, "h w 2"]:
    """How many events got darker and brighter at each pixel; rectified ones at the nearest."""
    xy = np.stack([events.x, events.y], -1).astype(np.float32)
    value = np.stack([events.p < 0, events.p > 0], -1).astype(np.float64)
    total = splat_nearest(xy, value, width=events.width, height=events.height)
    return total.astype(np.int32)


def signed(counts: Int32[np.ndarray, "*n h w 2"]) -> Int32[np.ndarray, "*n h w"]:
    """Brighter minus darker."""
    return counts[..., 1] - counts[..., 0]


def without_few(
    frames: Int32[np.ndarray, "*n h w"], least_share: float
) -> Int32[np.ndarray, "*n h w"]:
    """Frames without pixels whose count is a small share of the largest in their frame.

    Args:
        frames: Signed counts.
        least_share: Smallest share that is kept; `PUBLISHED_SHARE` is what the released pictures
            of EvDNeRF show, 0 keeps all.
    """
    most = np.abs(frames).max((-2, -1), keepdims=True)
    return np.where(np.abs(frames) >= least_share * most, frames, 0).astype(np.int32)


def windows(start_us: int, end_us: int, length_us: int) -> list[int]:
    """Times at which windows end; the last one may be shorter."""
    if length_us < 1:
        raise OptionError("windows must have a length", got=f"{length_us} us")
    return [*range(start_us + length_us, end_us, length_us), end_us]


def write_frames(
    folder: Path, counts: Sequence[Int32[np.ndarray, "h w 2"]], *, least_share: float = 0.0
) -> None:
    """Write a folder of event frames; it appears whole or not at all.

    Raises:
        OptionError: The folder is there and holds something else.
    """
    if folder.exists() and not (folder / COUNTS).is_file():
        raise OptionError(
            "will not replace a folder that holds other things than event frames",
            where=folder,
            do="choose another name for the events, or move it away",
        )
    whole = np.stack(counts)
    frames = without_few(signed(whole), least_share)
    full = busy(frames)
    pictures = [colour_signs(frame, full) for frame in frames]
    with replacing_folder(folder) as temporary:
        np.save(temporary / COUNTS, whole)
        np.save(temporary / FRAMES, frames)
        for number, picture in enumerate(pictures):
            write_image(temporary / f"{number:04d}.png", picture)
        write_film(temporary / FILM, pictures, rate=RATE)


def busy(frames: Int32[np.ndarray, "*n h w"]) -> float:
    """The count that gets the full colour: high among the pixels where something happened."""
    some = np.abs(frames[frames != 0])
    return float(np.percentile(some, FULL)) if len(some) else 1.0
