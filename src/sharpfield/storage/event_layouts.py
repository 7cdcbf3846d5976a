"""Layouts of event files, recognised by what is inside.

- DSEC: HDF5 with `events/{x, y, t, p}`, times in us after `t_offset`, and `ms_to_idx`, which
  gives the first event at or after each millisecond.
- Ours: a superset of it, written by `storage.event_writer`. Attributes give the sensor's size and
  the unit; any tool that reads DSEC reads it.
- Flat: HDF5 or npz with `x, y, t, p` at the root (EDS, Ev-DeblurNeRF, vid2e). It says neither
  the unit of its times nor the size of the sensor, so the caller must; an npz of ours says both,
  as arrays `tick_ns`, `width` and `height`.

Source: Gehrig et al., *DSEC* (RA-L 2021), for the layout; the rest from files as published.
"""

import importlib
import importlib.util
import zipfile
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import h5py
import numpy as np

from sharpfield.core.errors import CaptureError, MissingExtra
from sharpfield.core.events import SiteColour
from sharpfield.storage.event_columns import ZippedColumn, known_unit, whole_us
from sharpfield.storage.event_file import UNREADABLE, EventFile

COLUMNS = ("x", "y", "t", "p")
TRACK = "track"
"""The column that files of several cameras have besides."""

TICKS = {1: "ns", 1000: "us", 1_000_000: "ms"}
"""Units of time by the attribute `tick_ns`."""

THRESHOLDS = ("threshold_off", "threshold_on")
"""Attributes of a file, and notes of a capture, that give the contrast thresholds."""

SUPERBLOCK = b"\x89HDF\r\n\x1a\n"
"""What HDF5 files begin with."""

BLOSC, PROPHESEE_ECF = 32001, 0x8ECF
"""Numbers of HDF5 compression filters that need a plugin."""


UNREADABLE_NPZ = (*UNREADABLE, KeyError)
"""What opening a damaged archive may end in: also in a member that is not there."""


def open_events(
    path: Path | str, *, unit: str | None = None, size: tuple[int, int] | None = None
) -> EventFile:
    """Open a file of events.

    Args:
        path: An `.h5`, `.hdf5` or `.npz` file.
        unit: Of the stored times (ns, us, ms, s), where the file does not say. What the file
            says is overruled.
        size: Width and height of the sensor, where the file does not say.

    Raises:
        CaptureError: The file is missing, truncated, or holds no events in a known layout.
        MissingExtra: It is compressed by Blosc and the plugin is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError("event file not found", where=path)
    opened = _open_npz(path) if path.suffix == ".npz" else _open_hdf5(path)
    counts = {name: len(column) for name, column in opened.columns.items()}
    if len(set(counts.values())) != 1:
        opened.close()
        raise CaptureError(
            "event columns have different lengths",
            where=path,
            got=", ".join(f"{name} {count}" for name, count in counts.items()),
            do="the file may be truncated: copy or convert it again",
        )
    return replace(
        opened,
        unit=known_unit(unit) if unit else opened.unit,
        size=size or opened.size,
    )


def _open_npz(path: Path) -> EventFile:
    with ExitStack() as resources:
        try:
            archive = resources.enter_context(zipfile.ZipFile(path))
            _expect_columns([name.removesuffix(".npy") for name in archive.namelist()], path)
            columns = {name: ZippedColumn(archive, f"{name}.npy") for name in COLUMNS}
            tick, *size = (_number(archive, name) for name in ("tick_ns", "width", "height"))
        except UNREADABLE_NPZ as error:
            raise CaptureError(
                "not a readable npz file", where=path, got=error, do="copy or write it again"
            ) from None
        return EventFile(
            path,
            columns,
            unit=TICKS.get(tick),
            size=(size[0], size[1]) if all(size) else None,
            resources=resources.pop_all(),
        )
    raise AssertionError("the block above returns or raises")


def _number(archive: zipfile.ZipFile, name: str) -> int:
    """A whole number that an npz file may hold; 0 if it does not."""
    if f"{name}.npy" not in archive.namelist():
        return 0
    with archive.open(f"{name}.npy") as member:
        stored = np.lib.format.read_array(member, allow_pickle=False)
    return int(stored) if stored.shape == () and stored.dtype.kind in "iu" else 0


def opened_hdf5(path: Path) -> h5py.File:
    """An HDF5 file, whatever it is compressed with.

    Raises:
        CaptureError: It cannot be opened.
    """
    compression_plugin()  # makes more compression filters known to HDF5
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


def _continued(path: Path) -> bool:
    """Whether an older superblock names another block, as only that of a file in parts does.

    Of damage that looks so, the library would believe any length, and make room for it.
    """
    with path.open("rb") as file:
        start = file.read(64)
    version, width = start[8:9], sum(start[13:14])
    if not start.startswith(SUPERBLOCK) or version not in (b"\0", b"\1"):
        return False
    place = 24 + 4 * version[0] + 3 * width
    return start[place : place + width] != b"\xff" * width


def _open_hdf5(path: Path) -> EventFile:
    with ExitStack() as resources:
        file = resources.enter_context(opened_hdf5(path))
        group = file.get("events")
        grouped = isinstance(group, h5py.Group)
        holder = group if grouped else file
        _expect_columns(holder, path)
        named = [*COLUMNS, *([TRACK] if TRACK in holder else [])]
        columns = {name: _column(holder, name, path) for name in named}
        tick = _whole(file, "tick_ns", 1000 if grouped else 0)
        unit = TICKS.get(tick)
        size = _whole(file, "width", 0), _whole(file, "height", 0)
        return EventFile(
            path,
            columns,
            unit=unit,
            size=size if all(size) else None,
            offset_us=_offset_us(file, unit or "us", path),
            ms_to_idx=_column(file, "ms_to_idx", path)
            if unit == "us" and "ms_to_idx" in file
            else None,
            bayer=str(file.attrs.get("bayer", "")),
            site_colour=_site_colour(file, path),
            thresholds=_thresholds(file),
            tracks=_whole(file, "tracks", 1),
            resources=resources.pop_all(),
        )
    raise AssertionError("the block above returns or raises")


def _whole(file: h5py.File, attribute: str, fallback: int) -> int:
    return int(np.asarray(file.attrs.get(attribute, fallback)).item())


def _thresholds(file: h5py.File) -> tuple[float, float] | None:
    if not set(THRESHOLDS) <= set(file.attrs):
        return None
    off, on = (float(np.asarray(file.attrs[name]).item()) for name in THRESHOLDS)
    return off, on


def _offset_us(file: h5py.File, unit: str, path: Path) -> int:
    stored = file.get("t_offset")
    if not isinstance(stored, h5py.Dataset):
        return 0
    return int(whole_us(np.array(stored[()]).reshape(1), unit, path)[0])


def compression_plugin() -> ModuleType | None:
    """The package that reads and writes Blosc in HDF5, if it is installed."""
    return importlib.import_module("hdf5plugin") if importlib.util.find_spec("hdf5plugin") else None


def _site_colour(file: h5py.File, path: Path) -> SiteColour | None:
    sites = file.get("site_colour")
    if not isinstance(sites, h5py.Group):
        return None
    x, y, channel = (_column(sites, name, path)[:] for name in ("x", "y", "channel"))
    return SiteColour(x, y, np.asarray(channel, np.int8))


def _expect_columns(names: Iterable[str], path: Path) -> None:
    found = sorted(names)
    if set(COLUMNS) <= set(found):
        return
    raise CaptureError(
        "no events in a known layout",
        where=path,
        got=f"holds {', '.join(found[:8]) or 'nothing'}",
        do="use x, y, t, p at the root or in a group 'events'"
        + ("; convert Prophesee's own HDF5 with their tools" if "CD" in found else ""),
    )


def _column(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    column = group[name]
    where = f"{path}, {column.name}"
    if not isinstance(column, h5py.Dataset) or column.ndim != 1 or column.dtype.kind not in "iufb":
        raise CaptureError(
            "an event column must be a one-dimensional array of numbers", where=where, got=column
        )
    expect_filters(column, where)
    expect_filled(column, where)
    return column


def expect_filled(column: h5py.Dataset, where: str) -> None:
    """Make sure that a data set is as long as it says: HDF5 makes zeros of what is not there.

    Raises:
        CaptureError: It is shorter.
    """
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


def expect_filters(column: h5py.Dataset, where: str) -> None:
    """Make sure that a data set can be unpacked.

    Raises:
        CaptureError: It is compressed in an unknown way.
        MissingExtra: It is compressed by Blosc and the plugin is not installed.
    """
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
