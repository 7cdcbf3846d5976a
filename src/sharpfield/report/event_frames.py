"""Event frames: the number of events of each pixel in each time window of a stream.

A folder of them holds

    counts.npy      int32 [n h w 2]: all events, darker and brighter
    frames.npy      int32 [n h w]: brighter minus darker, optionally without low counts
    0000.png ...    frames.npy as images: red brighter, blue darker, one scale for all
    frames.mp4      the images as a video

Source: EvDNeRF (WACV 2024), whose figures leave out pixels with few events (`without_low_counts`).
"""

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import ceil, floor
from pathlib import Path

import numpy as np
from jaxtyping import Int32, Int64

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.events.image import splat_nearest
from sharpfield.report.colormaps import FULL_PERCENTILE, colour_signs
from sharpfield.report.video import Image, write_video
from sharpfield.storage.images import write_image

COUNTS, FRAMES, VIDEO = "counts.npy", "frames.npy", "frames.mp4"

PUBLISHED_SHARE = 0.3
"""Smallest share of the largest count of a frame that the published figures show."""

FPS = 20.0
"""Windows per second of the video."""

AppendCounts = Callable[[Int32[np.ndarray, "h w 2"]], None]
"""Appends the counts of the next window."""


def count_events(events: EventStream) -> Int32[np.ndarray, "h w 2"]:
    """Number of events to darker and to brighter at each (nearest) pixel."""
    xy = np.stack([events.x, events.y], -1).astype(np.float32)
    value = np.stack([events.p < 0, events.p > 0], -1).astype(np.float64)
    total = splat_nearest(xy, value, width=events.width, height=events.height)
    return total.astype(np.int32)


def signed(counts: Int32[np.ndarray, "*n h w 2"]) -> Int32[np.ndarray, "*n h w"]:
    """Count of events to brighter minus those to darker."""
    return counts[..., 1] - counts[..., 0]


def without_low_counts(
    frames: Int32[np.ndarray, "*n h w"], least_share: float
) -> Int32[np.ndarray, "*n h w"]:
    """Frames with counts set to zero that are a small share of the largest in their frame.

    Args:
        frames: Signed counts.
        least_share: Smallest share that is kept; `PUBLISHED_SHARE` as in the released images of
            EvDNeRF, 0 keeps all.
    """
    largest = np.abs(frames).max((-2, -1), keepdims=True)
    return np.where(np.abs(frames) >= least_share * largest, frames, 0).astype(np.int32)


def windows(start_us: int, end_us: int, length_us: int) -> list[int]:
    """End times of consecutive windows; the last window may be shorter."""
    if length_us < 1:
        raise OptionError("windows must have a length", got=f"{length_us} us")
    return [*range(start_us + length_us, end_us, length_us), end_us]


@contextmanager
def writing_frames(
    folder: Path, number: int, *, least_share: float = 0.0
) -> Iterator[AppendCounts]:
    """Gives a function that appends the counts of a window.

    The folder appears complete, at the end, or not at all. Only one frame is in memory: arrays are
    written to disk as they come; images, which share a scale, are drawn at the end.

    Args:
        folder: Replaced if it holds event frames.
        number: Number of windows; exactly as many must be appended.
        least_share: See `without_low_counts`; applies to frames and images, not to counts.

    Raises:
        OptionError: The folder exists and holds something else.
    """
    if folder.exists() and not (folder / COUNTS).is_file():
        raise OptionError(
            "will not replace a folder that holds other files than event frames",
            where=folder,
            do="choose another name for the events, or move it away",
        )
    with replacing_folder(folder) as temporary:
        arrays: list[np.memmap] = []
        histogram = [np.zeros(1, np.int64)]
        done = itertools.count()

        def append(counts: Int32[np.ndarray, "h w 2"]) -> None:
            if not arrays:
                shapes = {COUNTS: (number, *counts.shape), FRAMES: (number, *counts.shape[:2])}
                for name, shape in shapes.items():
                    array = np.lib.format.open_memmap(temporary / name, "w+", np.int32, shape)
                    arrays.append(array)
            at = next(done)
            frame = without_low_counts(signed(counts), least_share)
            arrays[0][at], arrays[1][at] = counts, frame
            total = np.bincount(np.abs(frame).ravel(), minlength=len(histogram[0]))
            total[: len(histogram[0])] += histogram[0]
            histogram[0] = total

        yield append
        assert next(done) == number, "the number of windows differs from the one announced"
        for array in arrays:
            array.flush()
        _draw(temporary, arrays[1], _full(histogram[0]))


def _full(histogram: Int64[np.ndarray, "n"]) -> float:
    """`full_count` of the frames with this histogram of absolute counts."""
    ends = np.cumsum(np.concatenate([[0], histogram[1:]]))  # active pixels up to each count
    if not ends[-1]:
        return 1.0
    rank = FULL_PERCENTILE / 100 * (ends[-1] - 1)
    low, high = np.searchsorted(ends, [floor(rank), ceil(rank)], "right")
    return float(low + (rank - floor(rank)) * (high - low))


def _draw(folder: Path, frames: Int32[np.ndarray, "n h w"], full: float) -> None:
    """Images of frames, and a video of the images."""

    def drawn() -> Iterator[Image]:
        for number, frame in enumerate(frames):
            image = colour_signs(np.asarray(frame), full)
            write_image(folder / f"{number:04d}.png", image)
            yield image

    write_video(folder / VIDEO, drawn(), fps=FPS)


def full_count(frames: Int32[np.ndarray, "*n h w"]) -> float:
    """The count that gets the full colour: a high percentile over the pixels with events."""
    active = np.abs(frames[frames != 0])
    return float(np.percentile(active, FULL_PERCENTILE)) if len(active) else 1.0
