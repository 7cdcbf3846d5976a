"""Event frames: how many events each pixel reported in each window of a stream.

A folder of them holds

    counts.npy      int32 [n h w 2]: darker and brighter, all that happened
    frames.npy      int32 [n h w]: brighter minus darker, without few events if that is asked
    0000.png ...    the same as images: red brighter, blue darker, one scale for all
    frames.mp4      the images one after another

Source: EvDNeRF (WACV 2024), whose figures leave out pixels with few events (`without_few`).
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
from sharpfield.report.colormaps import FULL, colour_signs
from sharpfield.report.video import Image, write_video
from sharpfield.storage.images import write_image

COUNTS, FRAMES, VIDEO = "counts.npy", "frames.npy", "frames.mp4"

PUBLISHED_SHARE = 0.3
"""Least share of a frame's largest count that the published figures show."""

RATE = 20.0
"""Windows per second of the video."""

Append = Callable[[Int32[np.ndarray, "h w 2"]], None]
"""Takes the counts of the next window."""


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
        least_share: Smallest share that is kept; `PUBLISHED_SHARE` is what the released images
            of EvDNeRF show, 0 keeps all.
    """
    most = np.abs(frames).max((-2, -1), keepdims=True)
    return np.where(np.abs(frames) >= least_share * most, frames, 0).astype(np.int32)


def windows(start_us: int, end_us: int, length_us: int) -> list[int]:
    """Times at which windows end; the last one may be shorter."""
    if length_us < 1:
        raise OptionError("windows must have a length", got=f"{length_us} us")
    return [*range(start_us + length_us, end_us, length_us), end_us]


@contextmanager
def writing_frames(folder: Path, number: int, *, least_share: float = 0.0) -> Iterator[Append]:
    """What takes the counts of each window; the folder appears whole, at the end, or not at all.

    Memory is that of one frame: arrays grow on disk, and images, which share a scale, are drawn
    at the end.

    Args:
        folder: Replaced if it holds event frames.
        number: Of windows; as many must come.
        least_share: See `without_few`; of frames and images, not of counts.

    Raises:
        OptionError: The folder is there and holds something else.
    """
    if folder.exists() and not (folder / COUNTS).is_file():
        raise OptionError(
            "will not replace a folder that holds other things than event frames",
            where=folder,
            do="choose another name for the events, or move it away",
        )
    with replacing_folder(folder) as temporary:
        arrays: list[np.memmap] = []
        found = [np.zeros(1, np.int64)]
        done = itertools.count()

        def append(counts: Int32[np.ndarray, "h w 2"]) -> None:
            if not arrays:
                shapes = {COUNTS: (number, *counts.shape), FRAMES: (number, *counts.shape[:2])}
                arrays.extend(_on_disk(temporary / name, shape) for name, shape in shapes.items())
            at = next(done)
            frame = without_few(signed(counts), least_share)
            arrays[0][at], arrays[1][at] = counts, frame
            found[0] = _added(found[0], np.bincount(np.abs(frame).ravel()))

        yield append
        assert next(done) == number, "as many windows must come as were announced"
        for array in arrays:
            array.flush()
        _draw(temporary, arrays[1], _full(found[0]))


def _on_disk(path: Path, shape: tuple[int, ...]) -> np.memmap:
    return np.lib.format.open_memmap(path, "w+", np.int32, shape)


def _added(a: Int64[np.ndarray, "n"], b: Int64[np.ndarray, "m"]) -> Int64[np.ndarray, "k"]:
    """Sum of two histograms of counts."""
    total = np.zeros(max(len(a), len(b)), np.int64)
    total[: len(a)] += a
    total[: len(b)] += b
    return total


def _full(histogram: Int64[np.ndarray, "n"]) -> float:
    """`busy` of the frames that a histogram of absolute counts was made of."""
    ends = np.cumsum(np.concatenate([[0], histogram[1:]]))  # busy pixels up to each count
    if not ends[-1]:
        return 1.0
    rank = FULL / 100 * (ends[-1] - 1)
    low, high = np.searchsorted(ends, [floor(rank), ceil(rank)], "right")
    return float(low + (rank - floor(rank)) * (high - low))


def _draw(folder: Path, frames: Int32[np.ndarray, "n h w"], full: float) -> None:
    """Images of frames, and a video of the images."""

    def drawn() -> Iterator[Image]:
        for number, frame in enumerate(frames):
            image = colour_signs(np.asarray(frame), full)
            write_image(folder / f"{number:04d}.png", image)
            yield image

    write_video(folder / VIDEO, drawn(), rate=RATE)


def busy(frames: Int32[np.ndarray, "*n h w"]) -> float:
    """The count that gets the full colour: high among the pixels where something happened."""
    some = np.abs(frames[frames != 0])
    return float(np.percentile(some, FULL)) if len(some) else 1.0
