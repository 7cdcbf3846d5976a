"""Opening HDF5 files that may be damaged, or compressed by filters that need a plugin."""

import importlib
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np

from sharpfield.core.errors import CaptureError, MissingExtra
from sharpfield.storage.arrays import UNREADABLE

SUPERBLOCK = b"\x89HDF\r\n\x1a\n"
"""Signature of HDF5 files."""

BLOSC, PROPHESEE_ECF = 32001, 0x8ECF
"""Numbers of HDF5 compression filters that need a plugin."""

DAMAGED = (*UNREADABLE, KeyError, TypeError, OverflowError, AttributeError)
"""Errors of h5py where the structure of a file is damaged: a type that does not exist ..."""


def open_hdf5_file(path: Path) -> h5py.File:
    """Open an HDF5 file for reading, whatever its compression.

    Raises:
        CaptureError: The file cannot be opened.
    """
    compression_plugin()  # registers more compression filters
    try:
        if _continued(path):
            raise OSError("a superblock that goes on elsewhere")
        return h5py.File(path, "r")
    except OSError as error:
        raise CaptureError(
            "cannot open the event file: it is missing, truncated, or not HDF5",
            where=path,
            got=error,
            do="copy or convert it again",
        ) from None


@contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Report errors of the HDF5 library as damage of the file.

    Raises:
        CaptureError: There was one.
    """
    try:
        yield
    except DAMAGED as error:
        raise CaptureError(
            "the file is damaged", where=path, got=error, do="copy or convert it again"
        ) from None


def dataset(holder: h5py.Group, name: str) -> h5py.Dataset:
    """A data set that can be decompressed and has all its rows.

    Raises:
        CaptureError: It is compressed by an unknown filter, or shorter than it says.
        KeyError: There is none of this name.
        MissingExtra: It is compressed by Blosc and the plugin is not installed.
        TypeError: It is no data set.
    """
    found: Any = holder[name]
    if not isinstance(found, h5py.Dataset):
        raise TypeError(f"{name} is no data set")
    where = f"{holder.file.filename}, {found.name}"
    _expect_filters(found, where)
    _expect_filled(found, where)
    return found


def compression_plugin() -> ModuleType | None:
    """The package that reads and writes Blosc in HDF5, if it is installed."""
    return importlib.import_module("hdf5plugin") if importlib.util.find_spec("hdf5plugin") else None


def _continued(path: Path) -> bool:
    """Whether an older superblock names another block, as only that of a file in parts does.

    In a damaged file, the library would trust any length there and allocate memory for it.
    """
    with path.open("rb") as file:
        start = file.read(64)
    version, width = start[8:9], sum(start[13:14])
    if not start.startswith(SUPERBLOCK) or version not in (b"\0", b"\1"):
        return False
    offset = 24 + 4 * version[0] + 3 * width
    return start[offset : offset + width] != b"\xff" * width


def _expect_filled(column: h5py.Dataset, where: str) -> None:
    """Check that all rows of a data set are stored: HDF5 reads missing ones as zeros."""
    if column.chunks is None:
        row = column.dtype.itemsize * int(np.prod(column.shape[1:]))
        filled = column.id.get_storage_size() // max(row, 1)
    else:
        across = [-(-n // k) for n, k in zip(column.shape[1:], column.chunks[1:], strict=True)]
        filled = column.id.get_num_chunks() // max(int(np.prod(across)), 1) * column.chunks[0]
    if filled < column.shape[0]:
        raise CaptureError(
            "event columns are shorter than they say",
            where=where,
            got=f"{filled} of {column.shape[0]} rows",
            do="the file may be truncated: copy or convert it again",
        )


def _expect_filters(column: h5py.Dataset, where: str) -> None:
    """Check that a data set can be decompressed."""
    settings = column.id.get_create_plist()
    for i in range(settings.get_nfilters()):
        code = settings.get_filter(i)[0]
        if h5py.h5z.filter_avail(code):
            continue
        if code == BLOSC:
            raise MissingExtra("hdf5plugin", extra="io", purpose=f"reading {where}")
        raise CaptureError(
            "events are compressed in a way that cannot be read here",
            where=where,
            got="Prophesee's ECF" if code == PROPHESEE_ECF else f"HDF5 filter {code}",
            do="convert the file with the maker's tools, to gzip or Blosc",
        )
