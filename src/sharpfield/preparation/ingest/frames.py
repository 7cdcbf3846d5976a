"""Writing the frames of a recording as PNG files, one by one while they are read."""

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
from sharpfield.preparation.ingest.lens import CaptureGeometry
from sharpfield.recordings.recording import Frame
from sharpfield.storage.images import write_image

CHANGE_WIDTH = 64
"""Width in pixels to which images are reduced to measure their change."""
FLOOR = 1 / 255
"""Lower limit of light before the logarithm."""


@dataclass(frozen=True)
class WrittenFrames:
    """Frames that were written."""

    names: tuple[str, ...]
    """File names without `.png`."""
    open_us: Int64[np.ndarray, "n"]
    close_us: Int64[np.ndarray, "n"]
    change: Float64[np.ndarray, "m"]
    """Mean absolute change of log light from each image to the next."""
    shape: tuple[int, int, int]
    bits: int

    def selected(self, keep: Shaped[np.ndarray, "n"]) -> "WrittenFrames":
        """Some of the frames, without their changes."""
        return WrittenFrames(
            tuple(name for name, is_kept in zip(self.names, keep, strict=True) if is_kept),
            self.open_us[keep],
            self.close_us[keep],
            np.empty(0),
            self.shape,
            self.bits,
        )


def write_frames(
    frames: Iterator[Frame],
    folder: Path,
    lens: CaptureGeometry,
    bayer: str,
    progress: Callable[[int], None],
) -> WrittenFrames:
    """Write all frames to a folder; files that exist already are kept.

    Args:
        frames: Frames in the order of time.
        folder: Folder of the images.
        lens: Maps images to the pixels of the capture.
        bayer: Colour filter array of the sensor, where images are raw.
        progress: Called with the number of frames written.

    Raises:
        CaptureError: There are no frames, or they differ in size or type.
    """
    names: list[str] = []
    known: set[str] = set()
    times: list[tuple[int, int]] = []
    change: list[float] = []
    before: Float32[np.ndarray, "y x"] | None = None
    shape: tuple[int, int, int] | None = None
    bits = 8
    for number, frame in enumerate(frames):
        image = lens.mapped_image(frame.image, bayer)
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
        progress(number + 1)
    if shape is None:
        raise CaptureError("the recording holds no frames", where=folder)
    opens, closes = np.array(times, np.int64).T
    return WrittenFrames(tuple(names), opens, closes, np.array(change), shape, bits)


def save_frames(frames: WrittenFrames, path: Path) -> None:
    """Save the record of all frames after the last one was written."""
    record: dict[str, Any] = {
        "names": frames.names,
        "open_us": frames.open_us.tolist(),
        "close_us": frames.close_us.tolist(),
        "change": frames.change.tolist(),
        "shape": frames.shape,
        "bits": frames.bits,
    }
    write_json(path, record)


def load_frames(path: Path) -> WrittenFrames:
    """Load what `save_frames` saved."""
    record = json.loads(path.read_text())
    height, width, channels = record["shape"]
    return WrittenFrames(
        tuple(record["names"]),
        np.array(record["open_us"], np.int64),
        np.array(record["close_us"], np.int64),
        np.array(record["change"], np.float64),
        (height, width, channels),
        record["bits"],
    )


def _name(own: str, number: int, known: set[str]) -> str:
    """The frame's own name if it is new and valid on every file system, else its number."""
    stem = re.sub(r"\.(png|jpe?g)$", "", own, flags=re.I)
    for name in (stem, f"{number:06d}"):
        if PLAIN_NAME.fullmatch(name) and name.casefold() not in known:
            known.add(name.casefold())
            return name
    known.add(f"frame_{number:06d}")
    return f"frame_{number:06d}"


def _log_small(image: Shaped[np.ndarray, "h w c"]) -> Float32[np.ndarray, "y x"]:
    """Logarithm of an image that is reduced to `CHANGE_WIDTH`."""
    height, width = image.shape[:2]
    grey = image.mean(-1, dtype=np.float32) / np.iinfo(image.dtype).max
    scale = min(CHANGE_WIDTH / width, 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.log(np.maximum(small, FLOOR))
