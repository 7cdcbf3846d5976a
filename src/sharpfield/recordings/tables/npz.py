"""Events in numpy files, as published with papers that train on events; and N-MNIST's binary files.

    npz, x y t p            EventNeRF, vid2e and many more; unit unknown, except in our own files
    npz, position timestamp polarity    Robust e-NeRF and Deblur e-NeRF; ns
    folder of npz, x y t p  vid2e: one for each interval between frames, `0000000000.npz` ...; ns
    npy, records            with fields x, y, t, p; unit unknown
    npy, a table            rows x y t p (BeNeRF) or t x y p (v2e, ECD); unit unknown

The order of the columns of a table follows from the values: times ascend, and polarities take two
values. Where both orders are possible, the caller must give it.

Source: Gehrig et al., *Video to Events* (CVPR 2020); Rudnev et al., *EventNeRF* (CVPR 2023); Low
and Lee, *Robust e-NeRF* (ICCV 2023); Li et al., *BeNeRF* (ECCV 2024).

The data sets N-MNIST and N-Caltech101 have five bytes per event, and one small file per image:

    x, 1 byte; y, 1 byte; polarity, 1 bit; time in us, 23 bits, most significant byte first

The file does not give the resolution. Row 240 marks a record that is no event: 2^13 us have passed.

Source: Orchard et al., *Converting static image datasets to spiking neuromorphic datasets using
saccades* (Frontiers in Neuroscience 2015), and the reader its authors publish.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import read_blocks, read_head, zip_holds
from sharpfield.recordings.chunks import RawChunk, merge_chunks, resolve_size
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    ReaderOptions,
    ReadLog,
    Recording,
    begins_with,
)
from sharpfield.recordings.tables.columns import column_recording
from sharpfield.storage.arrays import Array, load_array
from sharpfield.storage.event_columns import TableColumn, known_unit
from sharpfield.storage.event_file import CHUNK, EventFile
from sharpfield.storage.event_layouts import npz_dialect, open_events
from sharpfield.storage.images import list_images

ORDERS = ("xytp", "txyp")
"""Possible orders of the columns of a table."""

NUMBERED = re.compile(r"\d{10}\.npz")
"""File names of vid2e; no other program is known to use them."""


def open_npz(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open an npz file of events.

    Args:
        path: The file.
        options: `unit` and `size`, where the file does not give them.

    Raises:
        CaptureError: The file has no events in a known layout, or its unit or size is unknown.
    """
    return column_recording(
        npz_dialect(path), path, lambda: open_events(path, unit=options.unit, size=options.size)
    )


def open_npz_folder(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a folder of npz files, each of which continues the one before it.

    Args:
        path: The folder.
        options: `unit` (ns by default for files of vid2e, known by their names) and `size`.

    Raises:
        CaptureError: There are none, or their unit or resolution is unknown.
    """
    files = sorted(path.glob("*.npz"))
    if not files:
        raise CaptureError("no npz files found", where=path)
    if options.unit is None and all(NUMBERED.fullmatch(file.name) for file in files):
        options = replace(options, unit="ns")
    opened = [open_npz(file, options) for file in files]
    log = ReadLog()

    def events() -> Chunks:
        before: int | None = None
        pass_log = log.start("events")
        for file in opened:
            for chunk in file.chunks():
                if before is not None and chunk.t_us[0] < before:
                    raise CaptureError(
                        "event times are not ascending",
                        where=f"{file.path}, event 0",
                        got=f"{chunk.t_us[0]} us after {before} us at the end of the file before",
                        do="name the files in the order of time",
                    )
                before = int(chunk.t_us[-1])
                yield chunk
            for kind, count in file.log.counts.items():
                pass_log.note(kind, count)

    return replace(opened[0], path=path, layout="folder of npz", events=events, log=log)


def open_npy(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open an npy file of events: a table of four columns, or records.

    Args:
        path: The file.
        options: `unit` and `size`; `columns`, the order of the columns of a table.

    Raises:
        CaptureError: The file holds no events, or its unit, resolution or columns are unknown.
    """
    array = load_array(path, mapped=True)
    unit = known_unit(options.unit) if options.unit else None
    if array.dtype.names is not None:
        columns = {name: TableColumn(array, field) for name, field in _fields(array, path).items()}
        return column_recording(
            "npy of records", path, lambda: EventFile(path, columns, unit, options.size)
        )
    if array.ndim != 2 or array.shape[1] != len("xytp") or array.dtype.kind not in "iufb":
        raise CaptureError(
            "an npy file of events is a table of four columns, or records x, y, t, p",
            where=path,
            got=f"shape {array.shape}, {array.dtype}",
        )
    order = options.columns or _order(array, path)
    if sorted(order) != sorted("xytp"):
        raise CaptureError(
            "unknown order of columns", where=path, got=order, do='write it like "xytp" or "txyp"'
        )
    columns = {name: TableColumn(array, order.index(name)) for name in "xytp"}
    return column_recording(
        f"npy table {order}", path, lambda: EventFile(path, columns, unit, options.size)
    )


def _fields(array: Array, path: Path) -> dict[str, str]:
    """Field names of x, y, t and p in records."""
    known = {"t": ("t", "ts", "timestamp", "time"), "p": ("p", "polarity", "pol", "on")}
    found = {
        name: field
        for name in "xytp"
        for field in known.get(name, (name,))
        if field in (array.dtype.names or ())
    }
    if len(found) != len("xytp") or array.ndim != 1:
        raise CaptureError(
            "records must have the fields x, y, t and p",
            where=path,
            got=f"{array.dtype.names}, shape {array.shape}",
        )
    return found


def _order(array: Array, path: Path) -> str:
    """The only order of the columns that the values allow."""
    possible = [order for order in ORDERS if _is_possible(array, order)]
    if len(possible) == 1:
        return possible[0]
    raise CaptureError(
        "cannot tell which column is which"
        if possible
        else "columns are neither x y t p nor t x y p",
        where=path,
        got=f"first row {array[0].tolist() if len(array) else 'none'}",
        do=f"give columns: one of {', '.join(possible or ORDERS)}",
    )


def _is_possible(array: Array, order: str) -> bool:
    before = -np.inf
    for first in range(0, len(array), CHUNK):
        rows = np.asarray(array[first : first + CHUNK], np.float64)
        x, y, t, p = (rows[:, order.index(name)] for name in "xytp")
        if not (np.isin(p, (-1, 0, 1)).all() and np.isfinite(np.stack([x, y])).all()):
            return False
        if t[0] < before or (t[1:] < t[:-1]).any():
            return False
        before = t[-1]
    return True


RECORD = 5
"""Bytes of an event."""

SIZES = {"nmnist": (34, 34), "ncaltech101": (240, 180)}
"""Resolution by data set; images of N-Caltech101 differ, and none is larger."""

NO_ROW, PAUSE_US = 240, 2**13
"""Row of a record that is no event, and the time that it stands for."""


def open_nmnist(path: Path | str, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a file of N-MNIST or N-Caltech101.

    Args:
        path: The file.
        options: `size`; see `SIZES`.

    Raises:
        CaptureError: The file is no such file, or the resolution was not given.
    """
    path = Path(path)
    log = ReadLog()
    if len(read_head(path, RECORD)) < RECORD:
        raise CaptureError(
            "the file holds no event", where=path, got="less than 5 bytes", do="copy it again"
        )
    size = resolve_size(None, options.size, path)

    def raw_chunks(pass_log: ReadLog) -> Iterator[RawChunk]:
        rest, paused_us = b"", 0
        for block in chain(read_blocks(path), [b""]):
            rest += block
            records = np.frombuffer(rest, np.uint8, len(rest) // RECORD * RECORD)
            rest = rest[len(records) :]
            x, y, high, middle, low = records.reshape(-1, RECORD).T.astype(np.int64)  # [5 n]
            pauses = np.cumsum(y == NO_ROW) * PAUSE_US + paused_us
            paused_us = int(pauses[-1]) if len(pauses) else paused_us
            t_us = ((high & 0x7F) << 16 | middle << 8 | low) + pauses
            p = np.where(high >> 7, 1, -1).astype(np.int8)
            yield RawChunk(x.astype(np.uint16), y.astype(np.uint16), t_us, p)[y != NO_ROW]
        pass_log.note("truncated records", int(len(rest) > 0))

    def events() -> Chunks:
        pass_log = log.start("events")
        return merge_chunks(raw_chunks(pass_log), size, where=path, log=pass_log)

    return Recording(path, "N-MNIST", size=size, events=events, log=log)


NPZ = Format(
    "npz",
    open_npz,
    holds="events",
    marks="npz",
    recognise=lambda path, head: zip_holds(path, head, ".npy"),
    options=("size", "unit"),
)
NPZ_FOLDER = Format(
    "npz-folder",
    open_npz_folder,
    holds="events",
    marks="a folder of npz",
    recognise=lambda path, head: (
        path.is_dir() and any(path.glob("*.npz")) and not list_images(path)
    ),
    options=("size", "unit"),
)
NPY = Format(
    "npy",
    open_npy,
    holds="events",
    marks="npy",
    recognise=begins_with(b"\x93NUMPY"),
    options=("size", "unit", "columns"),
)
NMNIST = Format("nmnist", open_nmnist, "events", "the name FILE.bin", suffixes=(".bin",))
