"""HDF5 recordings: events in any dialect of `storage.event_layouts`, and frames of three of them.

    M3ED                     ovc/{left, right, rgb}/data, from cameras beside the event cameras, and
                             ovc/ts in us
    MVSEC                    davis/{left, right}/image_raw, and image_raw_ts in s
    E2VID, event_utils       images/image%09d, each with an attribute `timestamp` in s

Where a file holds several cameras, the caller chooses one; frames are those of the same side unless
another camera is chosen for them. Frames of these files have one time each and no exposure.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Format,
    Frame,
    ReaderOptions,
    Recording,
    begins_with,
)
from sharpfield.recordings.tables.columns import column_recording
from sharpfield.storage.event_columns import whole_us
from sharpfield.storage.event_layouts import CAMERA, find_dialect, open_events
from sharpfield.storage.hdf5 import SUPERBLOCK, damage_reported, dataset, open_hdf5_file

ReadFrames = Callable[[h5py.File, str], Iterator[Frame]]


def open_hdf5(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open an HDF5 file of events.

    Args:
        path: The file.
        options: `unit` and `size`, where the file does not give them; `topic`, which of several
            cameras, e.g. "left"; `image_topic`, which camera's frames, if not those of the same
            side, or "" for none.

    Raises:
        CaptureError: The file has no events in a known dialect, or its unit or size is unknown.
    """
    with damage_reported(path):
        with open_hdf5_file(path) as file:
            dialect, camera = find_dialect(file, options.topic)
        opened = column_recording(
            dialect.name,
            path,
            lambda: open_events(path, unit=options.unit, size=options.size, camera=camera),
        )
        return replace(opened, frames=_frames(path, dialect.name, camera, options.image_topic))


def _frames(
    path: Path, dialect: str, camera: str, chosen: str | None
) -> Callable[[], Iterator[Frame]] | None:
    """Function that reads the frames; None if there are none."""
    if dialect not in FRAMES or chosen == "":
        return None
    images, read = FRAMES[dialect]
    name = camera if chosen is None else chosen
    with open_hdf5_file(path) as file:
        before, star, after = images.partition(CAMERA)
        group: Any = file.get(before.rstrip("/") or "/") if star else None
        available = [one for one in group or () if f"{before}{one}{after}" in file]
        exists = name in available if star else images in file and not chosen
    if chosen and not exists:
        raise CaptureError(
            "the file has no frames of that camera",
            where=path,
            got=chosen,
            do=f"choose an image topic: {', '.join(available) or 'there is no choice here'}",
        )

    def frames() -> Iterator[Frame]:
        with damage_reported(path), open_hdf5_file(path) as file:
            yield from read(file, name)

    return frames if exists else None


def _mvsec_frames(file: h5py.File, camera: str) -> Iterator[Frame]:
    images, times = (dataset(file, f"davis/{camera}/image_raw{end}") for end in ("", "_ts"))
    times_us = whole_us(times[:], "s", file.filename)
    for image, t_us in zip(images, times_us.tolist(), strict=False):
        yield Frame(image, t_us, t_us)


def _m3ed_frames(file: h5py.File, camera: str) -> Iterator[Frame]:
    images, times = dataset(file, f"ovc/{camera}/data"), dataset(file, "ovc/ts")
    if images.ndim != 4 or images.shape[3] not in (1, 3):
        raise CaptureError(
            "frames must be images of one or three channels",
            where=f"{file.filename}, {images.name}",
            got=images,
        )
    times_us = whole_us(times[:], "us", file.filename)
    for image, t_us in zip(images, times_us.tolist(), strict=False):
        # Colours are stored as BGR.
        yield Frame(image[..., 0] if image.shape[2] == 1 else image[..., ::-1], t_us, t_us)


def _numbered_frames(file: h5py.File, camera: str) -> Iterator[Frame]:
    images: Any = file["images"]
    for name in sorted(images):
        image = images[name]
        stamp = np.asarray(image.attrs.get("timestamp", np.nan), np.float64).reshape(-1)[:1]
        t_us = int(whole_us(stamp, "s", f"{file.filename}, images/{name}")[0])
        yield Frame(image[:], t_us, t_us, name)


FRAMES: dict[str, tuple[str, ReadFrames]] = {
    "M3ED": (f"ovc/{CAMERA}/data", _m3ed_frames),
    "MVSEC": (f"davis/{CAMERA}/image_raw", _mvsec_frames),
    "event_utils HDF5": ("images", _numbered_frames),
}
"""Path of the frames and function that reads them, by dialect."""

FORMAT = Format(
    "hdf5",
    open_hdf5,
    holds="events; frames of M3ED, MVSEC and event_utils",
    marks="HDF5",
    recognise=begins_with(SUPERBLOCK),
    options=("size", "unit", "topic", "image_topic"),
)
