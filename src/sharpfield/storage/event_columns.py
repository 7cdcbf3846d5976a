"""Conversion of the columns of event files to those of an `EventStream`.

Files store times in ns, us, ms or s, as integers or floats; polarities as {0, 1}, {-1, +1} or
booleans; coordinates as integers of any width or as floats, if rectified. Units are never guessed.
"""

import zipfile
from typing import Any

import h5py
import numpy as np
from jaxtyping import Int8, Int64, Shaped

from sharpfield.core.errors import CaptureError, OptionError

UNITS = {"ns": 1e-3, "us": 1.0, "ms": 1e3, "s": 1e6}
"""Units of time, in us."""

LATEST_US = 2.0**62
"""Upper limit of plausible times: 146,000 years."""

Stored = Shaped[np.ndarray, "n"]
"""A column as the file has it: integers, floats or booleans."""


def known_unit(unit: str) -> str:
    """Return the unit itself.

    Raises:
        OptionError: It is not one of `UNITS`.
    """
    if unit not in UNITS:
        raise OptionError("unknown unit of time", got=unit, do=f"use one of {', '.join(UNITS)}")
    return unit


def whole_us(stored: Stored, unit: str, where: object) -> Int64[np.ndarray, "n"]:
    """Times in whole us; finer ones are rounded, halves upwards.

    Raises:
        CaptureError: A time is not finite.
    """
    if np.issubdtype(stored.dtype, np.floating):
        wrong = np.flatnonzero(~(np.abs(stored) < LATEST_US / UNITS[unit]))
        if len(wrong):
            finite = np.isfinite(stored[wrong[0]])
            raise CaptureError(
                "a time is implausibly large" if finite else "a time is not a finite number",
                where=f"{where}, entry {wrong[0]}",
                got=stored[wrong[0]],
                do="check the unit" if finite else "drop these entries when converting",
            )
        return np.floor(stored.astype(np.float64) * UNITS[unit] + 0.5).astype(np.int64)
    ticks = stored.astype(np.int64)
    if unit == "ns":
        return (ticks + 500) // 1000
    return ticks * int(UNITS[unit])


def polarity(stored: Stored, where: object) -> Int8[np.ndarray, "n"]:
    """Polarities as -1 and +1, from {0, 1}, {-1, +1} or booleans.

    Raises:
        CaptureError: There is another value, or 0 and -1 both occur.
    """
    positive, zero, negative = stored == 1, stored == 0, stored == -1
    wrong = np.flatnonzero(~(positive | zero | negative))
    if len(wrong):
        raise CaptureError(
            "polarity must be 0 or 1, or -1 or +1",
            where=f"{where}, event {wrong[0]}",
            got=stored[wrong[0]],
            do="check which column is which",
        )
    if zero.any() and negative.any():
        raise CaptureError(
            "polarity takes three values",
            where=where,
            got=f"{negative.sum()} times -1, {zero.sum()} times 0, {positive.sum()} times 1",
            do="map negative events to -1 or to 0, not to both",
        )
    return np.where(positive, 1, -1).astype(np.int8)


def coordinates(stored: Stored, name: str, where: object) -> Stored:
    """Pixel coordinates as 16-bit integers, or rectified ones as floats.

    Raises:
        CaptureError: An integer does not fit into 16 bits.
    """
    if np.issubdtype(stored.dtype, np.floating):
        return stored.astype(np.float32) if stored.dtype.itemsize < 4 else stored
    if stored.dtype in (np.int16, np.uint16):
        return stored
    if len(stored) and (stored.min() < 0 or stored.max() > np.iinfo(np.uint16).max):
        raise CaptureError(
            "events lie outside the sensor",
            where=where,
            got=f"{name} from {stored.min()} to {stored.max()}",
            do="check which column is which",
        )
    return stored.astype(np.uint16)


class ZippedColumn:
    """One array of an npz archive, read in parts, so that it need not fit in memory.

    Args:
        archive: The npz file.
        name: Name of the member, with `.npy`.
        axes: Number of dimensions that the array must have: 1, or 2 for a table read by rows.
    """

    def __init__(self, archive: zipfile.ZipFile, name: str, axes: int = 1) -> None:
        self._file = archive.open(name)
        where = f"{archive.filename}, {name}"
        version = np.lib.format.read_magic(self._file)
        if version == (1, 0):
            header = np.lib.format.read_array_header_1_0(self._file)
        elif version == (2, 0):
            header = np.lib.format.read_array_header_2_0(self._file)
        else:
            raise CaptureError(
                "unknown version of the npy format",
                where=where,
                got=version,
                do="save it with np.savez",
            )
        self.shape, by_column, self.dtype = header
        if self.dtype.hasobject:
            raise CaptureError(
                "array holds pickled Python objects, which may run code when loaded",
                where=where,
                do="save it as plain numbers: np.savez(path, t=t.astype(np.int64), ...)",
            )
        if len(self.shape) != axes or self.dtype.kind not in "iufb" or (by_column and axes > 1):
            dimensions = "one-dimensional" if axes == 1 else f"{axes}-dimensional, row by row"
            raise CaptureError(
                f"an event column must be a {dimensions} array of numbers",
                where=where,
                got=f"shape {self.shape}, {self.dtype}",
                do="save each column as an array of its own",
            )
        self._start = self._file.tell()
        self._row = int(np.prod(self.shape[1:])) * self.dtype.itemsize
        stated, holds = self._start + len(self) * self._row, archive.getinfo(name).file_size
        if stated != holds:
            raise CaptureError(
                "array is shorter or longer than its header states",
                where=where,
                got=f"{holds} bytes instead of {stated}",
                do="the file may be damaged: copy or convert it again",
            )

    def __len__(self) -> int:
        """Number of entries."""
        return self.shape[0]

    def __getitem__(self, part: slice) -> Shaped[np.ndarray, "n ..."]:
        """Entries, or rows, `part.start` to `part.stop`."""
        first, last, _ = part.indices(len(self))
        self._file.seek(self._start + first * self._row)
        data = self._file.read(max(last - first, 0) * self._row)
        return np.frombuffer(data, self.dtype).reshape(-1, *self.shape[1:])


class TableColumn:
    """One column of a table, or one field of records, read part by part.

    Args:
        table: An array on disk: HDF5, zipped, or memory-mapped.
        column: Index of the column, or name of the field.
    """

    def __init__(self, table: Any, column: int | str) -> None:
        self._table, self._column = table, column

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._table)

    def __getitem__(self, part: slice) -> Stored:
        """Entries `part.start` to `part.stop`."""
        if isinstance(self._table, h5py.Dataset):
            if isinstance(self._column, str):
                return self._table.fields(self._column)[part]
            return self._table[part, self._column]
        rows = self._table[part]
        return np.array(
            rows[self._column] if isinstance(self._column, str) else rows[:, self._column]
        )
