"""Dialects of event files in HDF5 and npz, recognised by their content.

HDF5:

    DSEC, TUM-VIE, ours      events/{x, y, t, p}, t in us after t_offset; ms_to_idx is the index of
                             the first event at or after each ms. Ours (`storage.event_writer`) adds
                             attributes for resolution and unit
    EDS, Ev-DeblurNeRF       {x, y, t, p} at the root; unit and resolution unknown
    M3ED                     prophesee/{left, right}/{x, y, t, p}; us
    E2VID, event_utils       events/{xs, ys, ts, ps}; s
    MVSEC                    davis/{left, right}/events, rows x, y, t, p; s
    v2e                      events, rows t, x, y, p; us
    Prophesee                CD/events, records x, y, p, t; us; compressed by a filter of their own
                             (ECF), which needs their plug-in

npz:

    EventNeRF, vid2e ...     x, y, t, p; unit and resolution unknown
    ours                     also tick_ns, width and height
    Robust e-NeRF            position (two columns), timestamp, polarity; ns

Source: Gehrig et al., *DSEC* (RA-L 2021); Klenk et al., *TUM-VIE* (IROS 2021); Chaney et al.,
*M3ED* (CVPRW 2023); Stoffregen et al., *Reducing the Sim-to-Real Gap for Event Cameras* (ECCV
2020); Zhu et al., *MVSEC* (RA-L 2018); Hu et al., *v2e* (CVPRW 2021); Low and Lee, *Robust e-NeRF*
(ICCV 2023); the rest from published files.
"""

import re
import zipfile
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import SiteColour
from sharpfield.storage.arrays import UNREADABLE
from sharpfield.storage.event_columns import TableColumn, ZippedColumn, known_unit, whole_us
from sharpfield.storage.event_file import Column, EventFile
from sharpfield.storage.hdf5 import damage_reported, dataset, open_hdf5_file

COLUMNS = ("x", "y", "t", "p")
TRACK = "track"
"""Additional column in files of several cameras."""

TICKS = {1: "ns", 1000: "us", 1_000_000: "ms"}
"""Units of time by the attribute `tick_ns`."""

THRESHOLDS = ("threshold_off", "threshold_on")
"""Attributes that give the contrast thresholds."""

CAMERA = "*"
"""Placeholder for the camera name in a path."""

UNREADABLE_NPZ = (*UNREADABLE, KeyError)
"""Errors of a damaged archive, also of a missing member."""

Size = tuple[int, int]


@dataclass(frozen=True)
class Dialect:
    """Where a kind of HDF5 file stores its events."""

    name: str
    events: str
    """Path of the group of columns, of the table, or of the records."""
    columns: tuple[str, ...] = COLUMNS
    """Names of x, y, t, p in the group or record; or the order of the columns of a table."""
    unit: str | None = "us"
    size: Callable[[h5py.File, str], Size | None] = lambda file, camera: None
    """Reads the sensor resolution from the file."""
    records: bool = False
    """Whether events are records with these fields."""

    @property
    def table(self) -> bool:
        """Whether events are rows of one table."""
        return self.columns[0] in ("xytp", "txyp")

    def cameras(self, file: h5py.File) -> list[str]:
        """Cameras whose events the file stores in this dialect; [""] if it holds one camera."""
        before, star, after = self.events.partition(f"{CAMERA}/")
        if not star:
            return [""] if self._holds(file.get(self.events)) else []
        group = file.get(before.rstrip("/"))
        if not isinstance(group, h5py.Group):
            return []
        return [str(name) for name in group if self._holds(file.get(f"{before}{name}/{after}"))]

    def read_columns(self, file: h5py.File, camera: str) -> dict[str, Column]:
        """Columns x, y, t and p of a camera, checked but not read."""
        path = self.events.replace(CAMERA, camera).rstrip("/") or "/"
        if self.records or self.table:
            stored = dataset(file, path)
            order = self.columns if self.records else map(self.columns[0].index, COLUMNS)
            return {n: TableColumn(stored, c) for n, c in zip(COLUMNS, order, strict=True)}
        group: Any = file[path]
        return {n: _column(group, c) for n, c in zip(COLUMNS, self.columns, strict=True)}

    def _holds(self, found: Any) -> bool:
        if self.records:
            named = isinstance(found, h5py.Dataset) and found.ndim == 1 and found.dtype.names
            return bool(named) and set(self.columns) <= set(found.dtype.names)
        if self.table:
            return isinstance(found, h5py.Dataset) and found.ndim == 2 and found.shape[1] == 4
        return isinstance(found, h5py.Group) and set(self.columns) <= set(found)


def open_events(
    path: Path | str,
    *,
    unit: str | None = None,
    size: Size | None = None,
    camera: str | None = None,
) -> EventFile:
    """Open a file of events.

    Args:
        path: An `.npz` file, or an HDF5 file of any other suffix.
        unit: Unit of the stored times (ns, us, ms, s); overrules what the file says.
        size: Sensor resolution, width and height; overrules what the file says.
        camera: Which of several cameras, e.g. "left".

    Raises:
        CaptureError: The file is missing, damaged, holds no events in a known dialect, or several
            cameras and none was chosen.
        MissingExtra: It is compressed by Blosc and the plugin is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError("event file not found", where=path, do="check the path")
    opened = _open_npz(path) if path.suffix == ".npz" else _open_hdf5(path, camera)
    counts = {name: len(column) for name, column in opened.columns.items()}
    if len(set(counts.values())) != 1:
        opened.close()
        raise CaptureError(
            "event columns have different lengths",
            where=path,
            got=", ".join(f"{name} {count}" for name, count in counts.items()),
            do="the file may be truncated: copy or convert it again",
        )
    unit = known_unit(unit) if unit else opened.unit
    return replace(opened, unit=unit, size=size or opened.size)


def find_dialect(file: h5py.File, camera: str | None) -> tuple[Dialect, str]:
    """The dialect of an HDF5 file, and the camera to read.

    Raises:
        CaptureError: The file holds no events in a known dialect, several cameras and none was
            chosen, or no such camera.
    """
    found = [(dialect, name) for dialect in DIALECTS for name in dialect.cameras(file)]
    ours = [(dialect, camera or "") for dialect in (DSEC, FLAT) if dialect.cameras(file)]
    found = found or ours[:1]
    if not found:
        group = file.get("events")
        raise _no_columns(group if isinstance(group, h5py.Group) else file, file.filename)
    if len(found) == 1 and camera in (None, found[0][1]):
        return found[0]
    named = [pair for pair in found if pair[1] == camera]
    if len(named) == 1:
        return named[0]
    raise CaptureError(
        "the file holds several cameras" if camera is None else "the file has no such camera",
        where=file.filename,
        got=", ".join(name for _, name in found) if camera is None else camera,
        do="choose a topic: " + ", ".join(name or "none" for _, name in found),
    )


def npz_dialect(path: Path) -> str:
    """Name of the dialect of an npz file, one of `NPZ_DIALECTS`.

    Raises:
        CaptureError: The file is no npz, or holds no events in a known dialect.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except UNREADABLE_NPZ as error:
        raise _unreadable_npz(path, error) from None
    for dialect, columns in NPZ_DIALECTS.items():
        if {array for array, _ in columns.values()} <= names:
            return dialect
    raise _no_columns(names, path)


def _open_npz(path: Path) -> EventFile:
    dialect = npz_dialect(path)
    with ExitStack() as resources:
        try:
            archive = resources.enter_context(zipfile.ZipFile(path))
            columns: dict[str, Column] = {}
            for name, (array, column) in NPZ_DIALECTS[dialect].items():
                stored = ZippedColumn(archive, f"{array}.npy", 1 if column is None else 2)
                columns[name] = stored if column is None else TableColumn(stored, column)
            tick, *size = (_number(archive, name) for name in ("tick_ns", "width", "height"))
        except UNREADABLE_NPZ as error:
            raise _unreadable_npz(path, error) from None
        return EventFile(
            path,
            columns,
            unit="ns" if dialect == ROBUST_E_NERF else TICKS.get(tick),
            size=(size[0], size[1]) if all(size) else None,
            resources=resources.pop_all(),
        )
    raise AssertionError("the block above returns or raises")


def _number(archive: zipfile.ZipFile, name: str) -> int:
    """An integer that an npz file may hold; 0 if it does not."""
    if f"{name}.npy" not in archive.namelist():
        return 0
    with archive.open(f"{name}.npy") as member:
        stored = np.lib.format.read_array(member, allow_pickle=False)
    return int(stored) if stored.shape == () and stored.dtype.kind in "iu" else 0


def _open_hdf5(path: Path, camera: str | None) -> EventFile:
    with damage_reported(path), ExitStack() as resources:
        file = resources.enter_context(open_hdf5_file(path))
        dialect, camera = find_dialect(file, camera)
        columns = dialect.read_columns(file, camera)
        tick = _integer(file, "tick_ns")
        unit = TICKS.get(tick) if tick else dialect.unit
        opened = EventFile(path, columns, unit=unit, size=dialect.size(file, camera))
        if dialect in (DSEC, FLAT):
            holder: Any = file[dialect.events]
            if TRACK in holder:
                columns[TRACK] = _column(holder, TRACK)
            indexed = unit == "us" and "ms_to_idx" in file
            opened = replace(
                opened,
                offset_us=_offset_us(file, unit or "us"),
                ms_to_idx=_column(file, "ms_to_idx") if indexed else None,
                bayer=str(file.attrs.get("bayer", "")),
                site_colour=_site_colour(file),
                thresholds=_thresholds(file),
                tracks=_integer(file, "tracks") or 1,
            )
        return replace(opened, resources=resources.pop_all())
    raise AssertionError("the block above returns or raises")


def _integer(file: h5py.File, attribute: str) -> int:
    """An integer attribute; 0 if there is none."""
    return int(np.asarray(file.attrs.get(attribute, 0)).item())


def _thresholds(file: h5py.File) -> tuple[float, float] | None:
    if not set(THRESHOLDS) <= set(file.attrs):
        return None
    off, on = (float(np.asarray(file.attrs[name]).item()) for name in THRESHOLDS)
    return off, on


def _offset_us(file: h5py.File, unit: str) -> int:
    stored = file.get("t_offset")
    if not isinstance(stored, h5py.Dataset):
        return 0
    return int(whole_us(np.array(stored[()]).reshape(1), unit, file.filename)[0])


def _site_colour(file: h5py.File) -> SiteColour | None:
    sites = file.get("site_colour")
    if not isinstance(sites, h5py.Group):
        return None
    x, y, channel = (_column(sites, name)[:] for name in ("x", "y", "channel"))
    return SiteColour(x, y, np.asarray(channel, np.int8))


def _no_columns(names: Iterable[str], path: object) -> CaptureError:
    found = sorted(names)
    return CaptureError(
        "no events in a known layout",
        where=path,
        got=f"holds {', '.join(found[:8]) or 'nothing'}",
        do="use x, y, t, p at the root or in a group 'events'"
        + ("; convert Prophesee's own HDF5 with their tools" if "CD" in found else ""),
    )


def _column(group: h5py.Group, name: str) -> h5py.Dataset:
    column: Any = group[name]
    if isinstance(column, h5py.Dataset) and column.ndim == 1 and column.dtype.kind in "iufb":
        return dataset(group, name)
    raise CaptureError(
        "an event column must be a one-dimensional array of numbers",
        where=f"{group.file.filename}, {column.name}",
        got=column,
        do="store x, y, t and p as arrays of equal length",
    )


def _unreadable_npz(path: Path, error: Exception) -> CaptureError:
    return CaptureError(
        "not a readable npz file", where=path, got=error, do="copy or write it again"
    )


def _our_size(file: h5py.File, camera: str) -> Size | None:
    size = _integer(file, "width"), _integer(file, "height")
    return size if all(size) else None


def _m3ed_size(file: h5py.File, camera: str) -> Size | None:
    stored = file.get(f"prophesee/{camera}/calib/resolution")
    if not isinstance(stored, h5py.Dataset) or stored.shape != (2,):
        return None
    width, height = (int(pixels) for pixels in stored[:])
    return width, height


def _attribute_size(file: h5py.File, camera: str) -> Size | None:
    """From the attribute `sensor_resolution`, height and width."""
    stored = np.asarray(file.attrs.get("sensor_resolution", ())).ravel()
    if len(stored) != 2 or stored.dtype.kind not in "iuf":
        return None
    return int(stored[1]), int(stored[0])


def _geometry_size(file: h5py.File, camera: str) -> Size | None:
    """From the attribute `geometry`, a text "1280x720"."""
    stored = file.attrs.get("geometry", "")
    text = stored.decode("latin-1") if isinstance(stored, bytes) else str(stored)
    match = re.fullmatch("([0-9]{1,5})x([0-9]{1,5})", text)
    return (int(match[1]), int(match[2])) if match else None


def _mvsec_size(file: h5py.File, camera: str) -> Size | None:
    """Resolution of the frames, which come from the pixels of the same sensor."""
    stored = file.get(f"davis/{camera}/image_raw")
    if not isinstance(stored, h5py.Dataset) or stored.ndim != 3:
        return None
    return stored.shape[2], stored.shape[1]


DSEC = Dialect("HDF5", "events", size=_our_size)
FLAT = Dialect("HDF5", "/", unit=None, size=_our_size)

DIALECTS = (
    Dialect("M3ED", f"prophesee/{CAMERA}/", size=_m3ed_size),
    Dialect("event_utils HDF5", "events", ("xs", "ys", "ts", "ps"), "s", _attribute_size),
    Dialect("MVSEC", f"davis/{CAMERA}/events", ("xytp",), "s", _mvsec_size),
    Dialect("v2e HDF5", "events", ("txyp",)),
    Dialect("Prophesee HDF5", "CD/events", size=_geometry_size, records=True),
)
"""Dialects other than `DSEC` and `FLAT`, and tried before them."""

ROBUST_E_NERF = "Robust e-NeRF npz"
NPZ_DIALECTS: dict[str, dict[str, tuple[str, int | None]]] = {
    ROBUST_E_NERF: {
        "x": ("position", 0),
        "y": ("position", 1),
        "t": ("timestamp", None),
        "p": ("polarity", None),
    },
    "npz": {name: (name, None) for name in COLUMNS},
}
"""Array, and column of it if it is a table, by event column."""
