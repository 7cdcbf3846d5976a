"""Frames of a recording, written one by one while they are read."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, Shaped

from sharpfield.captures.native.frames import PLAIN_NAME
from sharpfield.core.errors import CaptureError
from sharpfield.core.files import write_json
from sharpfield.preparation.ingest.lens import Geometry
from sharpfield.recordings.recording import Frame
from sharpfield.storage.images import write_image

SMALL = 64
"""Width in pixels of the images whose change is measured."""
FLOOR = 1 / 255
"""Light below which no logarithm is taken."""


@dataclass(frozen=True)
class WrittenFrames:
    """The frames that were written."""

    names: tuple[str, ...]
    """Files are `NAME.png`."""
    open_us: Int64[np.ndarray, "n"]
    close_us: Int64[np.ndarray, "n"]
    change: Float64[np.ndarray, "m"]
    """Mean absolute change of log light from each image to the next."""
    shape: tuple[int, int, int]
    bits: int

    def picked(self, keep: Shaped[np.ndarray, "n"]) -> "Taken":
        """Some of the frames; changes are dropped."""
        return WrittenFrames(
            tuple(name for name, kept in zip(self.names, keep, strict=True) if kept),
            self.open_us[keep],
            self.close_us[keep],
            np.empty(0),
            self.shape,
            self.bits,
        )


def write_frames_of(
    frames: Iterator[Frame],
    folder: Path,
    lens: Geometry,
    bayer: str,
    heard: Callable[[int], None],
) -> WrittenFrames:
    """Write all frames to a folder; those that are there already are left as they are.

    Args:
        frames: In the order of time.
        folder: Of the images.
        lens: How images come to the capture's pixels.
        bayer: Filter tile of the sensor, where images are raw.
        heard: Is told how many were written.

    Raises:
        CaptureError: There are none, or they differ in size or type.
    """
    names: list[str] = []
    known: set[str] = set()
    times: list[tuple[int, int]] = []
    change: list[float] = []
    before: Float32[np.ndarray, "y x"] | None = None
    shape: tuple[int, int, int] | None = None
    bits = 8
    for number, frame in enumerate(frames):
        image = lens.image(frame.image, bayer)
        bits = 8 * image.dtype.itemsize
        if shape is not None and image.shape != shape:
            raise CaptureError(
                "frames differ in size or colour",
                where=f"frame {frame.name or number}",
                got=f"{image.shape} after {shape}",
                do="record with one setting of the camera",
            )
        shape = image.shape[0], image.shape[1], image.shape[2]
        names.append(_name(frame.name, number, known))
        times.append((frame.open_us, frame.close_us))
        file = folder / f"{names[-1]}.png"
        if not file.exists():
            write_image(file, image)
        small = _log_small(image)
        if before is not None:
            change.append(float(np.abs(small - before).mean()))
        before = small
        heard(number + 1)
    if shape is None:
        raise CaptureError("the recording holds no frames", where=folder)
    opens, closes = np.array(times, np.int64).T
    return WrittenFrames(tuple(names), opens, closes, np.array(change), shape, bits)


def save_frames(taken: WrittenFrames, path: Path) -> None:
    """Write down which frames were taken, when all of them were."""
    about: dict[str, Any] = {
        "names": taken.names,
        "open_us": taken.open_us.tolist(),
        "close_us": taken.close_us.tolist(),
        "change": taken.change.tolist(),
        "shape": taken.shape,
        "bits": taken.bits,
    }
    write_json(path, about)


def load_frames(path: Path) -> WrittenFrames:
    """What `save_frames` wrote."""
    about = json.loads(path.read_text())
    height, width, channels = about["shape"]
    return WrittenFrames(
        tuple(about["names"]),
        np.array(about["open_us"], np.int64),
        np.array(about["close_us"], np.int64),
        np.array(about["change"], np.float64),
        (height, width, channels),
        about["bits"],
    )


def _name(own: str, number: int, known: set[str]) -> str:
    """The frame's own name where every file system can hold it and it is new, else its number."""
    stem = re.sub(r"\.(png|jpe?g)$", "", own, flags=re.I)
    for name in (stem, f"{number:06d}"):
        if PLAIN_NAME.fullmatch(name) and name.casefold() not in known:
            known.add(name.casefold())
            return name
    known.add(f"frame_{number:06d}")
    return f"frame_{number:06d}"


def _log_small(image: Shaped[np.ndarray, "h w c"]) -> Float32[np.ndarray, "y x"]:
    """The logarithm of what a image looks like from afar."""
    height, width = image.shape[:2]
    grey = image.mean(-1, dtype=np.float32) / np.iinfo(image.dtype).max
    scale = min(SMALL / width, 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.log(np.maximum(small, FLOOR))
