"""Recordings of files that store events as columns: shared by HDF5, npz and npy.

The file is a `storage.EventFile`, read a chunk at a time. Events outside the sensor are left out
and counted, as is everything after a part that cannot be read. A time unit or sensor resolution
that the file does not give must come from the caller; it is never guessed.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64, Shaped

from sharpfield.core.capture import Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.recordings.chunks import expect_inside
from sharpfield.recordings.recording import Chunks, ReadLog, Recording
from sharpfield.storage.event_columns import UNITS
from sharpfield.storage.event_file import CHUNK, EventFile

OpenFile = Callable[[], EventFile]
"""Opens the file again."""


def column_recording(layout: str, path: Path, open_file: OpenFile) -> Recording:
    """Make a recording of the events of a file.

    Raises:
        CaptureError: The file cannot be opened, or its time unit or resolution is unknown.
    """
    log = ReadLog()
    with open_file() as file:
        _expect_unit(file)
        _expect_size(file)
        integral = _integral(file)
        size, bayer, stated = file.size, file.bayer, file.thresholds

    def events() -> Chunks:
        with open_file() as opened:
            yield from _chunks(opened, log.start("events"), integral=integral)

    return Recording(
        path,
        layout,
        size=size,
        events=events,
        bayer=bayer,
        thresholds=None if stated is None else Thresholds(*stated),
        log=log,
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
    t_us: Int64[np.ndarray, "n"],
    numbers: Int64[np.ndarray, "n"],
    before: int | None,
    path: Path,
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


def _expect_size(file: EventFile) -> None:
    if file.size is None:
        raise CaptureError(
            "the file does not state its sensor resolution",
            where=file.path,
            do="give width and height in pixels",
        )
