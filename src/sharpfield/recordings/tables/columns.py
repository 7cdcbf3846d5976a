"""Files that store events as columns: HDF5 in any dialect of `storage.event_layouts`, and npz, npy.

`column_recording` reads any `storage.EventFile` a chunk at a time. Events outside the sensor are
left out and counted, as is everything after a part that cannot be read. A time unit or sensor
resolution that the file does not give must come from the caller; it is never guessed.

Frames of HDF5 files are read in three dialects:

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
from jaxtyping import Bool, Int64, Shaped

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.chunks import expect_inside, resolve_size
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    Frame,
    ReaderOptions,
    ReadLog,
    Recording,
    begins_with,
)
from sharpfield.storage.event_columns import UNITS, whole_us
from sharpfield.storage.event_file import CHUNK, EventFile
from sharpfield.storage.event_layouts import CAMERA, find_dialect, open_events
from sharpfield.storage.hdf5 import SUPERBLOCK, damage_reported, dataset, open_hdf5_file


def column_recording(layout: str, path: Path, open_file: Callable[[], EventFile]) -> Recording:
    """Make a recording of the events of a file; `open_file` opens it again.

    Raises:
        CaptureError: The file cannot be opened, or its time unit or resolution is unknown.
    """
    log = ReadLog()
    with open_file() as file:
        _expect_unit(file)
        size, integral = resolve_size(file.size, None, file.path), _integral(file)
        bayer, thresholds = file.bayer, file.thresholds

    def events() -> Chunks:
        with open_file() as opened:
            yield from _chunks(opened, log.start("events"), integral=integral)

    return Recording(
        path, layout, size=size, events=events, bayer=bayer, thresholds=thresholds, log=log
    )


def _chunks(file: EventFile, log: ReadLog, *, integral: bool) -> Chunks:
    before: int | None = None
    outside = 0
    for first in range(0, len(file), CHUNK):
        last = min(first + CHUNK, len(file))
        try:
            stored = {name: file.stored(name, first, last) for name in file.columns}
        except CaptureError:
            if not first:
                raise
            log.note("events from a damaged part onwards", len(file) - first)
            return
        keep = _inside(stored, file.size, integral=integral)
        outside += (left_out := int((~keep).sum()))
        log.note("events outside the sensor", left_out)
        if left_out:
            assert file.size is not None, "the size was expected when the file was opened"
            column, row = (float(np.nan_to_num(stored[name]).max()) for name in ("x", "y"))
            expect_inside(outside, last, (column, row), file.size, file.path)
        columns = {name: column[keep] for name, column in stored.items()}
        if integral:
            columns |= {name: columns[name].astype(np.uint16) for name in ("x", "y")}
        numbers = first + np.flatnonzero(keep)
        part = replace(file, columns=columns, ms_to_idx=None).part(0, len(numbers))
        _expect_order(part.t_us, numbers, before, file.path)
        if len(part):
            before = int(part.t_us[-1])
            yield part


def _inside(
    stored: dict[str, Shaped[np.ndarray, "n"]], size: tuple[int, int] | None, *, integral: bool
) -> Bool[np.ndarray, "n"]:
    """Mask of events on the sensor; rectified ones may lie up to one sensor size beside it."""
    assert size is not None, "the size was expected when the file was opened"
    keep = np.ones(len(stored["t"]), bool)
    for name, pixels in zip(("x", "y"), size, strict=True):
        column = stored[name]
        if integral or column.dtype.kind != "f":
            keep &= (column >= 0) & (column < pixels)
            if integral and column.dtype.kind == "f":
                keep &= np.floor(column) == column
        else:
            keep &= (column >= -pixels) & (column <= 2 * pixels - 1)
    return keep


def _expect_order(
    t_us: Int64[np.ndarray, "n"], numbers: Int64[np.ndarray, "n"], before: int | None, path: Path
) -> None:
    back = np.flatnonzero(np.diff(t_us) < 0)
    if before is not None and len(t_us) and t_us[0] < before:
        number, pair = numbers[0], (before, t_us[0])
    elif len(back):
        number, pair = numbers[back[0] + 1], (t_us[back[0]], t_us[back[0] + 1])
    else:
        return
    raise CaptureError(
        "event times are not ascending",
        where=f"{path}, event {number}",
        got=f"{pair[1]} us after {pair[0]} us",
        do="sort the events by time (stable), and check that clock wraps were undone",
    )


def _integral(file: EventFile) -> bool:
    """Whether the first chunk has integer coordinates; rectified events do not."""
    with np.errstate(invalid="ignore"):  # also for signalling NaN
        return all(
            bool(((np.floor(column) == column) | ~np.isfinite(column)).all())
            for column in (file.stored(name, 0, min(len(file), CHUNK)) for name in ("x", "y"))
        )


def _expect_unit(file: EventFile) -> None:
    if file.unit is not None or not len(file):
        return
    first, last = (file.stored("t", i, i + 1)[0].item() for i in (0, len(file) - 1))
    lasts = ", ".join(
        f"{(last - first) * UNITS[unit] / 1e6:.4g} s if {unit}" for unit in ("ns", "us", "ms", "s")
    )
    raise CaptureError(
        "the file does not state the unit of its event times",
        where=file.path,
        got=f"{first} to {last}, which is {lasts}",
        do="give the unit: ns, us, ms or s",
    )


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


FRAMES: dict[str, tuple[str, Callable[[h5py.File, str], Iterator[Frame]]]] = {
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
