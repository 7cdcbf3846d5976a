"""Event streams and their per-pixel index, memory-mapped from the disk cache if they are large.

An `EventStream` needs plain arrays, and a compressed file has none. So the events of a large file
are decompressed, a chunk at a time, to one `.npy` per column in the disk cache, and the arrays of
the stream map these files. Small files are loaded. The per-pixel index (`events.index`) of a mapped
stream lies in the same folder.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from sharpfield.core.events import EventStream
from sharpfield.events.index import EventIndex, build_index, site_offsets, sort_sites
from sharpfield.events.sites import find_sites
from sharpfield.storage.disk_cache import cache_folder, cache_key, cached
from sharpfield.storage.event_file import EventFile

IN_MEMORY = 50_000_000
"""Up to this number of events (0.7 GB) are loaded, more are memory-mapped."""

SORTED_AT_ONCE = 2**26
"""Events that are sorted in memory at a time when an index is written: 9 bytes each."""

COLUMNS = ("x", "y", "t_us", "p", "track")
"""Columns of a stream; `track` only where there are several cameras."""

ABOUT = "events.json"
"""Marks the folder of a stream, and states what it was made from."""


def read_events(
    file: EventFile, *, between: tuple[int, int] | None = None, in_memory: int = IN_MEMORY
) -> EventStream:
    """Every event of a file, checked; memory-mapped if there are many.

    Args:
        file: An open file of events.
        between: First and last time (us, both included) of the events; by default all.
        in_memory: Maximum number of events that are loaded.

    Raises:
        CaptureError: The events are invalid, see `core.events.checked`.
    """
    folder = _mapped_columns(file, between) if len(file) > in_memory else None
    if folder is not None:
        empty = file.part(0, 0)
        columns = {name: _mapped(folder / f"{name}.npy") for name in _columns(empty)}
        return replace(empty, **columns)
    stream = _filled(file, 0, len(file), lambda name, kind: np.empty(len(file), kind))
    return stream if between is None else stream.window(between[0], between[1] + 1)


def event_index(events: EventStream) -> EventIndex:
    """The per-pixel index of a stream: built in memory, or mapped if the stream is mapped."""
    folder = _folder_of(events)
    if folder is None:
        return build_index(events)
    key = cache_key([folder / "t_us.npy"])
    entry = cached(folder, "index", key, lambda path: write_index(events, path))
    return build_index(events) if entry is None else open_index(entry, events.tracks)


def write_index(events: EventStream, folder: Path, *, at_once: int = SORTED_AT_ONCE) -> None:
    """Write the index of a stream, an `.npy` for each of its arrays.

    Args:
        events: The stream; its arrays may be memory-mapped.
        folder: An existing folder.
        at_once: Maximum number of events in memory while sorting; a single pixel may have more.

    Raises:
        CaptureError: See `events.index.build_index`.
    """
    site_xy, site_of = find_sites(events)
    offset = site_offsets(events, site_of, len(site_xy))
    np.save(folder / "site_xy.npy", site_xy)
    np.save(folder / "offset.npy", offset)
    t_us = _created(folder / "t_us.npy", np.dtype(np.int64), len(events))
    p = _created(folder / "p.npy", np.dtype(np.int8), len(events))
    for first, last in site_ranges(offset, at_once):
        part = slice(offset[first], offset[last])
        t_us[part], p[part] = sort_sites(events, site_of, offset, first=first, last=last)
    t_us.flush()
    p.flush()


def open_index(folder: Path, tracks: int) -> EventIndex:
    """The memory-mapped index that `write_index` wrote, of a stream of so many cameras."""
    arrays = [_mapped(folder / f"{name}.npy") for name in ("site_xy", "offset", "t_us", "p")]
    return EventIndex(*(np.asarray(array) for array in arrays), tracks=tracks)


def site_ranges(offset: Int64[np.ndarray, "o"], most: int) -> list[tuple[int, int]]:
    """Consecutive ranges of sites with at most `most` events each, or with a single site."""
    ranges: list[tuple[int, int]] = []
    first, sites = 0, len(offset) - 1
    while first < sites:
        last = int(np.searchsorted(offset, int(offset[first]) + most, side="right")) - 1
        last = min(max(last, first + 1), sites)
        ranges.append((first, last))
        first = last
    return ranges


def _filled(
    file: EventFile, first: int, last: int, make: Callable[[str, np.dtype], np.ndarray]
) -> EventStream:
    """Events `first` to `last - 1`, in columns that `make` allocates by name and type."""
    stream = file.part(first, first)
    columns = {name: make(name, getattr(stream, name).dtype) for name in _columns(stream)}
    at = 0
    for chunk in file.chunks(first, last):
        for name, column in columns.items():
            column[at : at + len(chunk)] = getattr(chunk, name)
        at += len(chunk)
    return replace(stream, **columns)


def _mapped_columns(file: EventFile, between: tuple[int, int] | None) -> Path | None:
    """The folder of the columns of a file in the disk cache; None if it cannot be written."""

    def write(folder: Path) -> None:
        first, last = 0, len(file)
        if between is not None:
            file.check()  # a search needs ascending times
            first, last = file.first_at(between[0]), file.first_at(between[1] + 1)

        def make(name: str, kind: np.dtype) -> np.ndarray:
            return _created(folder / f"{name}.npy", kind, last - first)

        _filled(file, first, last, make)
        about = {"source": file.path.name, "unit": file.unit, "between": between}
        (folder / ABOUT).write_text(json.dumps(about) + "\n")

    key = cache_key([file.path], file.unit, between)
    return cached(cache_folder(file.path), file.path.stem, key, write, replaces=True)


def _columns(stream: EventStream) -> list[str]:
    return [name for name in COLUMNS if getattr(stream, name) is not None]


def _folder_of(events: EventStream) -> Path | None:
    """The cache folder whose files a stream maps, if it maps all of them from end to end."""
    times = events.t_us
    if not isinstance(times, np.memmap) or times.filename is None:
        return None
    folder = Path(times.filename).parent
    whole = (folder / ABOUT).is_file() and len(_mapped(folder / "t_us.npy")) == len(times)
    return folder if whole else None


def _created(path: Path, kind: np.dtype, length: int) -> np.memmap:
    return np.lib.format.open_memmap(path, "w+", kind, (length,))


def _mapped(path: Path) -> np.ndarray:
    return np.load(path, mmap_mode="r", allow_pickle=False)
