"""Files of events, opened without being loaded: any window of time, any part, or chunk by chunk.

Three layouts, recognised by what is inside:

- DSEC: HDF5 with `events/{x, y, t, p}`, times in us after `t_offset`, and `ms_to_idx`, which
  gives the first event at or after each millisecond.
- Ours: a superset of it, written by `captures.event_writer`. Attributes give the sensor's size and
  the unit; a file without sub-us times is read by any tool that reads DSEC.
- Flat: HDF5 or npz with `x, y, t, p` at the root (EDS, Ev-DeblurNeRF, vid2e). It says neither
  the unit of its times nor the size of the sensor, so the caller must.

Source: Gehrig et al., *DSEC* (RA-L 2021), for the layout; the rest from files as published.
"""

import importlib.util
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Protocol, runtime_checkable

import h5py
import numpy as np
from jaxtyping import Int64

from sharpfield.captures.event_columns import (
    Stored,
    ZippedColumn,
    coordinates,
    known_unit,
    polarity,
    whole_us,
)
from sharpfield.core.errors import CaptureError, MissingExtra
from sharpfield.core.events import EventStream, SiteColour, checked

COLUMNS = ("x", "y", "t", "p")
CHUNK = 2**20
"""Events looked at together; bounds the memory of whatever goes through a file."""

SEARCHED = 2**16
"""Times unpacked at once when looking for one: an HDF5 chunk or so."""

TICKS = {1: "ns", 1000: "us", 1_000_000: "ms"}
"""Units of time by the attribute `tick_ns`."""

BLOSC, PROPHESEE_ECF = 32001, 0x8ECF
"""Storeds of HDF5 compression filters that need a plugin."""


@runtime_checkable
class Column(Protocol):
    """A one-dimensional array that is read piece by piece."""

    dtype: np.dtype

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice) -> Stored: ...


@dataclass(frozen=True)
class EventFile:
    """Events on disk. Close it, or use it in a `with` statement."""

    path: Path
    columns: Mapping[str, Column]
    unit: str | None
    """Of the stored times: ns, us, ms or s. None where neither the file nor the caller says."""
    size: tuple[int, int] | None
    """Width and height of the sensor in pixels; None where nobody says."""
    offset_us: int = 0
    """What stored times count from."""
    ms_to_idx: Column | None = None
    bayer: str = ""
    site_colour: SiteColour | None = None
    resources: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> "EventFile":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.resources.close()

    def __len__(self) -> int:
        """Stored of events."""
        return len(self.columns["t"])

    def part(self, first: int, last: int) -> EventStream:
        """Events number `first` to `last - 1`; their order is not checked.

        Raises:
            CaptureError: They cannot be read, or the unit or the size is not known.
        """
        width, height = self._needed_size()
        return EventStream(
            x=coordinates(self.stored("x", first, last), "x", self.path),
            y=coordinates(self.stored("y", first, last), "y", self.path),
            t_us=self._times(first, last),
            p=polarity(self.stored("p", first, last), self.path),
            width=width,
            height=height,
            bayer=self.bayer,
            site_colour=self.site_colour,
        )

    def window(self, start_us: int, end_us: int) -> EventStream:
        """Events with start <= t < end, found without reading the others."""
        return self.part(self.first_at(start_us), self.first_at(end_us))

    def chunks(self, first: int = 0, last: int | None = None) -> Iterator[EventStream]:
        """Consecutive events, `CHUNK` at a time, checked one by one and against each other.

        Raises:
            CaptureError: See `core.events.checked`.
        """
        last = len(self) if last is None else last
        before: int | None = None
        for begin in range(first, last, CHUNK):
            end = min(begin + CHUNK, last)
            chunk = checked(self.part(begin, end), f"{self.path}, events {begin} to {end - 1}")
            if before is not None and chunk.t_us[0] < before:
                raise CaptureError(
                    "event times are not ascending",
                    where=self.path,
                    got=f"event {begin - 1} at {before} us, event {begin} at {chunk.t_us[0]} us",
                    do="sort the events by time (stable), and check that clock wraps were undone",
                )
            before = int(chunk.t_us[-1])
            yield chunk

    def check(self) -> None:
        """Look at every event once, in bounded memory.

        Raises:
            CaptureError: See `core.events.checked`.
        """
        for _ in self.chunks():
            pass

    def span_us(self) -> tuple[int, int]:
        """Times of the first and the last event; (0, 0) if there are none."""
        if not len(self):
            return 0, 0
        return int(self._times(0, 1)[0]), int(self._times(len(self) - 1, len(self))[0])

    def first_at(self, time_us: int) -> int:
        """Stored of the first event at or after a time; the count of events if there is none."""
        low, high = 0, len(self)
        if self.ms_to_idx is not None and len(self.ms_to_idx):
            ms = (time_us - self.offset_us) // 1000
            marks = len(self.ms_to_idx)
            if ms >= 0:
                low = int(self.ms_to_idx[min(ms, marks - 1) : min(ms, marks - 1) + 1][0])
            if ms + 1 < marks:
                high = int(self.ms_to_idx[max(ms, -1) + 1 : max(ms, -1) + 2][0])
        while high - low > SEARCHED:
            middle = (low + high) // 2
            if self._times(middle, middle + 1)[0] < time_us:
                low = middle + 1
            else:
                high = middle
        return low + int(np.searchsorted(self._times(low, high), time_us))

    def stored(self, name: str, first: int, last: int) -> Stored:
        """A part of a column as the file has it.

        Raises:
            CaptureError: It cannot be read.
        """
        try:
            return self.columns[name][first:last]
        except (OSError, EOFError, zipfile.BadZipFile) as error:
            raise CaptureError(
                "cannot read events",
                where=f"{self.path}, column {name}, events {first} to {last - 1}",
                got=error,
                do="the file may be truncated: copy or convert it again",
            ) from None

    def _times(self, first: int, last: int) -> Int64[np.ndarray, "n"]:
        if self.unit is None:
            raise CaptureError(
                "the file does not say the unit of its event times",
                where=self.path,
                got="datasets x, y, t, p at the root",
                do="give the unit: ns, us, ms or s",
            )
        return whole_us(self.stored("t", first, last), self.unit, self.path) + self.offset_us

    def _needed_size(self) -> tuple[int, int]:
        if self.size is None:
            raise CaptureError(
                "the file does not say the size of its sensor",
                where=self.path,
                do="give width and height in pixels",
            )
        return self.size


def open_events(
    path: Path, *, unit: str | None = None, size: tuple[int, int] | None = None
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
    resources = ExitStack()
    try:
        archive = resources.enter_context(zipfile.ZipFile(path))
        inside = {name.removesuffix(".npy") for name in archive.namelist()}
        _expect_columns(inside, path)
        columns = {name: ZippedColumn(archive, f"{name}.npy") for name in COLUMNS}
    except (zipfile.BadZipFile, ValueError) as error:
        raise CaptureError(
            "not a readable npz file", where=path, got=error, do="copy or write it again"
        ) from None
    return EventFile(path, columns, unit=None, size=None, resources=resources)


def _open_hdf5(path: Path) -> EventFile:
    compression_plugin()  # makes more compression filters known to HDF5
    resources = ExitStack()
    try:
        file = resources.enter_context(h5py.File(path, "r"))
    except OSError as error:
        raise CaptureError(
            "cannot open the event file: it is truncated, or not HDF5",
            where=path,
            got=f"{path.stat().st_size} bytes; {error}",
            do="copy or convert it again",
        ) from None
    group = file["events"] if isinstance(file.get("events"), h5py.Group) else file
    _expect_columns(set(group), path)
    columns = {name: group[name] for name in COLUMNS}
    for name, column in columns.items():
        _expect_plain(column, f"{path}, {column.name}")
        _expect_filters(column, f"{path}, {name}")
    tick = file.attrs.get("tick_ns", 1000 if group is not file else None)
    unit = None if tick is None else TICKS.get(int(tick))
    offset = np.array([file["t_offset"][()] if "t_offset" in file else 0])
    return EventFile(
        path,
        columns,
        unit=unit,
        size=(int(file.attrs["width"]), int(file.attrs["height"]))
        if {"width", "height"} <= set(file.attrs)
        else None,
        offset_us=int(whole_us(offset, unit or "us", path)[0]),
        ms_to_idx=file.get("ms_to_idx") if unit == "us" else None,
        bayer=str(file.attrs.get("bayer", "")),
        site_colour=_site_colour(file),
        resources=resources,
    )


def compression_plugin() -> ModuleType | None:
    """The package that reads and writes Blosc in HDF5, if it is installed."""
    return importlib.import_module("hdf5plugin") if importlib.util.find_spec("hdf5plugin") else None


def _site_colour(file: h5py.File) -> SiteColour | None:
    sites = file.get("site_colour")
    if sites is None:
        return None
    return SiteColour(sites["x"][:], sites["y"][:], sites["channel"][:].astype(np.int8))


def _expect_columns(found: set[str], path: Path) -> None:
    if set(COLUMNS) <= found:
        return
    raise CaptureError(
        "no events in a known layout",
        where=path,
        got=f"holds {', '.join(sorted(found)[:8]) or 'nothing'}",
        do="use x, y, t, p at the root or in a group 'events';"
        + (" convert Prophesee's own HDF5 with their tools" if "CD" in found else ""),
    )


def _expect_plain(column: object, where: str) -> None:
    if not isinstance(column, h5py.Dataset) or column.ndim != 1 or column.dtype.kind not in "iufb":
        raise CaptureError(
            "an event column must be a one-dimensional array of numbers", where=where, got=column
        )


def _expect_filters(column: h5py.Dataset, where: str) -> None:
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
