"""HDF5 files of events, in the dialects of data sets and programs.

    DSEC, TUM-VIE, ours      events/{x, y, t, p}, see `storage.event_layouts`; us
    EDS, Ev-DeblurNeRF       {x, y, t, p} at the root; unit unknown
    M3ED                     prophesee/{left, right}/{x, y, t, p}; us; ovc/{left, right, rgb}/data,
                             from cameras beside the event cameras, and ovc/ts in us
    E2VID, event_utils       events/{xs, ys, ts, ps}; s; images/image%09d with a time each
    MVSEC                    davis/{left, right}/events, rows x, y, t, p; s; image_raw, image_raw_ts
    v2e                      events, rows t, x, y, p; us
    Prophesee                CD/events, records x, y, p, t; us

Where a file holds several cameras, the caller chooses one; frames are those of the same side unless
another camera is chosen for them. Frames of these files have one time each and no exposure.

Prophesee's files use a compression of their own (ECF): HDF5 needs their plug-in to read them.

Source: Gehrig et al., *DSEC* (RA-L 2021); Klenk et al., *TUM-VIE* (IROS 2021); Chaney et al.,
*M3ED* (CVPRW 2023); Stoffregen et al., *Reducing the Sim-to-Real Gap for Event Cameras* (ECCV
2020); Zhu et al., *MVSEC* (RA-L 2018); Hu et al., *v2e* (CVPRW 2021).
"""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
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
from sharpfield.storage.event_columns import known_unit, whole_us
from sharpfield.storage.event_file import UNREADABLE, EventFile
from sharpfield.storage.event_layouts import (
    SUPERBLOCK,
    expect_filled,
    expect_filters,
    open_events,
    opened_hdf5,
)

CAMERA = "*"
"""Placeholder for the camera name in a path."""

DAMAGED = (*UNREADABLE, KeyError, TypeError, OverflowError, AttributeError)
"""Errors of h5py where the structure of a file is damaged: a type that does not exist ..."""


@dataclass(frozen=True)
class Dialect:
    """Where a kind of file stores events and frames."""

    layout: str
    events: str
    """Path of the group of columns, or of the table."""
    columns: tuple[str, ...]
    """Names of x, y, t, p in the group or record; or the order of the columns of a table."""
    unit: str
    size: Callable[[h5py.File, str], tuple[int, int] | None] = lambda file, camera: None
    """Reads the sensor resolution from the file."""
    frames: Callable[[h5py.File, str], Iterator[Frame]] | None = None
    images: str = ""
    """Path of the frames; "" if there are none."""
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

    def path(self, camera: str) -> str:
        """Path of the events of a camera."""
        return self.events.replace(CAMERA, camera).rstrip("/")

    def _holds(self, found: Any) -> bool:
        if self.records:
            named = isinstance(found, h5py.Dataset) and found.ndim == 1 and found.dtype.names
            return bool(named) and set(self.columns) <= set(found.dtype.names)
        if self.table:
            return isinstance(found, h5py.Dataset) and found.ndim == 2 and found.shape[1] == 4
        return isinstance(found, h5py.Group) and set(self.columns) <= set(found)


class TableColumn:
    """One column of a table, or one field of records, read part by part."""

    def __init__(self, table: h5py.Dataset, column: int | str) -> None:
        self._table, self._column = table, column

    def __len__(self) -> int:
        """Number of rows."""
        return self._table.shape[0]

    def __getitem__(self, part: slice) -> np.ndarray:
        """Entries `part.start` to `part.stop`."""
        if isinstance(self._column, str):
            return self._table.fields(self._column)[part]
        return self._table[part, self._column]


def open_hdf5(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open an HDF5 file of events.

    Args:
        path: The file.
        options: `unit` and `size`, where the file does not give them; `topic`, which of several
            cameras, e.g. "left"; `image_topic`, which camera's frames, if not those of the same
            side, or "" for none.

    Raises:
        CaptureError: The file has no events in a known layout, or its unit or size is unknown.
    """
    unit, size = options.unit, options.size
    with _damage_reported(path):
        with opened_hdf5(path) as file:
            found = [(d, camera) for d in DIALECTS for camera in d.cameras(file)]
        if not found:
            return column_recording("HDF5", path, lambda: open_events(path, unit=unit, size=size))
        dialect, camera = _chosen(found, options.topic, path)
        made = column_recording(
            dialect.layout, path, lambda: _event_file(path, dialect, camera, unit, size)
        )
        return replace(made, frames=_frames(path, dialect, camera, options.image_topic))


def _frames(
    path: Path, dialect: Dialect, camera: str, chosen: str | None
) -> Callable[[], Iterator[Frame]] | None:
    """Function that reads the frames; None if there are none."""
    read, name = dialect.frames, camera if chosen is None else chosen
    if read is None or chosen == "":
        return None
    with opened_hdf5(path) as file:
        before, star, after = dialect.images.partition(CAMERA)
        group: Any = file.get(before.rstrip("/") or "/") if star else None
        available = [one for one in group or () if f"{before}{one}{after}" in file]
        there = name in available if star else dialect.images in file and not chosen
    if chosen and not there:
        raise CaptureError(
            "the file has no frames of that camera",
            where=path,
            got=chosen,
            do=f"choose an image topic: {', '.join(available) or 'there is no choice here'}",
        )

    def frames() -> Iterator[Frame]:
        with _damage_reported(path), opened_hdf5(path) as file:
            yield from read(file, name)

    return frames if there else None


def _chosen(found: list[tuple[Dialect, str]], topic: str | None, path: Path) -> tuple[Dialect, str]:
    if topic is None and len(found) == 1:
        return found[0]
    named = [pair for pair in found if pair[1] == topic]
    if len(named) == 1:
        return named[0]
    raise CaptureError(
        "the file holds several cameras" if topic is None else "the file has no such camera",
        where=path,
        got=", ".join(camera for _, camera in found) if topic is None else topic,
        do="choose a topic: " + ", ".join(camera or "none" for _, camera in found),
    )


def _event_file(
    path: Path, dialect: Dialect, camera: str, unit: str | None, size: tuple[int, int] | None
) -> EventFile:
    with ExitStack() as resources:
        file = resources.enter_context(opened_hdf5(path))
        stored: Any = file[dialect.path(camera)]
        columns: dict[str, Any]
        if dialect.table or dialect.records:
            expect_filters(stored, f"{path}, {stored.name}")
            expect_filled(stored, f"{path}, {stored.name}")
            order = dialect.columns if dialect.records else map(dialect.columns[0].index, "xytp")
            columns = {
                name: TableColumn(stored, column)
                for name, column in zip("xytp", order, strict=True)
            }
        else:
            columns = {
                name: _column(stored, dialect.columns[i], path) for i, name in enumerate("xytp")
            }
        if len({len(column) for column in columns.values()}) != 1:
            raise CaptureError(
                "event columns have different lengths",
                where=path,
                got=", ".join(f"{name} {len(column)}" for name, column in columns.items()),
                do="the file may be truncated: copy or convert it again",
            )
        return EventFile(
            path,
            columns,
            unit=known_unit(unit) if unit else dialect.unit,
            size=size or dialect.size(file, camera),
            resources=resources.pop_all(),
        )
    raise AssertionError("the block above returns or raises")


def _column(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    column: Any = group[name]
    if isinstance(column, h5py.Dataset) and column.ndim == 1 and column.dtype.kind in "iufb":
        expect_filled(column, f"{path}, {column.name}")
        return column
    raise CaptureError(
        "an event column must be a one-dimensional array of numbers",
        where=f"{path}, {group.name}/{name}",
        got=column,
    )


@contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
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


def _m3ed_size(file: h5py.File, camera: str) -> tuple[int, int] | None:
    stored = file.get(f"prophesee/{camera}/calib/resolution")
    if not isinstance(stored, h5py.Dataset) or stored.shape != (2,):
        return None
    width, height = (int(pixels) for pixels in stored[:])
    return width, height


def _attribute_size(file: h5py.File, camera: str) -> tuple[int, int] | None:
    """From the attribute `sensor_resolution`, height and width."""
    stored = np.asarray(file.attrs.get("sensor_resolution", ())).ravel()
    if len(stored) != 2 or stored.dtype.kind not in "iuf":
        return None
    return int(stored[1]), int(stored[0])


def _geometry_size(file: h5py.File, camera: str) -> tuple[int, int] | None:
    """From the attribute `geometry`, a text "1280x720"."""
    stored = file.attrs.get("geometry", "")
    text = stored.decode("latin-1") if isinstance(stored, bytes) else str(stored)
    match = re.fullmatch("([0-9]{1,5})x([0-9]{1,5})", text)
    return (int(match[1]), int(match[2])) if match else None


def _mvsec_size(file: h5py.File, camera: str) -> tuple[int, int] | None:
    """Resolution of the frames, which come from the pixels of the same sensor."""
    stored = file.get(f"davis/{camera}/image_raw")
    if not isinstance(stored, h5py.Dataset) or stored.ndim != 3:
        return None
    return stored.shape[2], stored.shape[1]


def _mvsec_frames(file: h5py.File, camera: str) -> Iterator[Frame]:
    images, times = (_filled(file, f"davis/{camera}/image_raw{end}") for end in ("", "_ts"))
    times_us = whole_us(times[:], "s", file.filename)
    for image, t_us in zip(images, times_us.tolist(), strict=False):
        yield Frame(image, t_us, t_us)


def _m3ed_frames(file: h5py.File, camera: str) -> Iterator[Frame]:
    images, times = _filled(file, f"ovc/{camera}/data"), _filled(file, "ovc/ts")
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


def _filled(file: h5py.File, name: str) -> Any:
    """A data set that is as long as its header says."""
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise TypeError(f"{name} is no data set")
    expect_filled(found, f"{file.filename}, {name}")
    return found


def _numbered_frames(file: h5py.File, camera: str) -> Iterator[Frame]:
    images: Any = file["images"]
    for name in sorted(images):
        image = images[name]
        stamp = np.asarray(image.attrs.get("timestamp", np.nan), np.float64).reshape(-1)[:1]
        t_us = int(whole_us(stamp, "s", f"{file.filename}, images/{name}")[0])
        yield Frame(image[:], t_us, t_us, name)


DIALECTS = (
    Dialect(
        "M3ED",
        f"prophesee/{CAMERA}/",
        ("x", "y", "t", "p"),
        "us",
        _m3ed_size,
        _m3ed_frames,
        f"ovc/{CAMERA}/data",
    ),
    Dialect(
        "event_utils HDF5",
        "events",
        ("xs", "ys", "ts", "ps"),
        "s",
        _attribute_size,
        _numbered_frames,
        "images",
    ),
    Dialect(
        "MVSEC",
        f"davis/{CAMERA}/events",
        ("xytp",),
        "s",
        _mvsec_size,
        _mvsec_frames,
        f"davis/{CAMERA}/image_raw",
    ),
    Dialect("v2e HDF5", "events", ("txyp",), "us"),
    Dialect(
        "Prophesee HDF5",
        "CD/events",
        ("x", "y", "t", "p"),
        "us",
        _geometry_size,
        records=True,
    ),
)
"""Dialects that `storage.event_layouts.open_events` does not read."""


FORMAT = Format(
    "hdf5",
    open_hdf5,
    holds="events; frames of M3ED, MVSEC and event_utils",
    marks="HDF5",
    recognise=begins_with(SUPERBLOCK),
    options=("size", "unit", "topic", "image_topic"),
)
