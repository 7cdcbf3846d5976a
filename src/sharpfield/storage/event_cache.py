"""Streams larger than memory: unpacked once beside the capture, memory-mapped ever after.

An `EventStream` needs plain arrays, and a compressed file has none. So the events of a large file
are unpacked, a chunk at a time, to one `.npy` per column in a cache folder, and the stream's arrays
are maps of these. Small files are simply loaded. The index by pixel (`ops.event_index`) of a
mapped stream is kept in the same folder. All of it is derived: delete the folder when you like.
"""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.events.index import EventIndex, build
from sharpfield.events.index_files import file_key, index_on_disk
from sharpfield.storage.event_file import EventFile

IN_MEMORY = 50_000_000
"""Up to this many events (0.7 GB) are loaded, more are mapped."""

COLUMNS = ("x", "y", "t_us", "p", "track")
"""Of a stream; `track` only where there are several cameras."""
ABOUT = "events.json"
"""Says what a cache was made from; written last."""


def read_events(
    file: EventFile, *, between: tuple[int, int] | None = None, in_memory: int = IN_MEMORY
) -> EventStream:
    """Every event of a file, checked; memory-mapped if there are many.

    Args:
        file: An open file of events.
        between: First and last time (us, both included) of the events to keep; by default all.
        in_memory: How many events may be loaded.

    Raises:
        CaptureError: The events are unsound, see `core.events.checked`.
    """
    if len(file) > in_memory:
        return _mapped(file, between)
    stream = _filled(file, 0, len(file), lambda name, kind: np.empty(len(file), kind))
    return stream if between is None else stream.window(between[0], between[1] + 1)


def event_index(events: EventStream) -> EventIndex:
    """The index by pixel of a stream: built in memory, or kept beside the files it maps."""
    folder = _mapped_folder(events)
    if folder is None:
        return build(events)
    return index_on_disk(events, folder / "index", key=file_key(folder / "t_us.npy"))


def cache_folder(path: Path) -> Path:
    """Where to keep what is derived from a file.

    It is `cache/` beside the file, or a folder of the user's own cache if that cannot be written.
    """
    beside = path.resolve().parent
    if os.access(beside, os.W_OK):
        return beside / "cache"
    digest = hashlib.blake2b(str(beside).encode(), digest_size=8).hexdigest()
    return Path.home() / ".cache" / "sharpfield" / digest


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


def _mapped(file: EventFile, between: tuple[int, int] | None) -> EventStream:
    folder = cache_folder(file.path) / file.path.stem
    about = {"source": file_key(file.path), "unit": file.unit, "between": between}
    about = json.loads(json.dumps(about))  # tuples become lists, as they will when read
    if _about(folder) != about:
        first, last = 0, len(file)
        if between is not None:
            file.check()  # a search needs ascending times
            first, last = file.first_at(between[0]), file.first_at(between[1] + 1)
        with replacing_folder(folder) as fresh:

            def make(name: str, kind: np.dtype) -> np.ndarray:
                path = fresh / f"{name}.npy"
                return np.lib.format.open_memmap(path, "w+", kind, (last - first,))

            _filled(file, first, last, make)
            (fresh / ABOUT).write_text(json.dumps(about) + "\n")
    none = file.part(0, 0)
    columns = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in _columns(none)}
    return replace(none, **columns)


def _columns(stream: EventStream) -> list[str]:
    return [name for name in COLUMNS if getattr(stream, name) is not None]


def _about(folder: Path) -> object:
    try:
        return json.loads((folder / ABOUT).read_text())
    except (OSError, json.JSONDecodeError):
        return None


def _mapped_folder(events: EventStream) -> Path | None:
    """The cache folder whose files a stream maps, if it maps all of them from end to end."""
    times = events.t_us
    if not isinstance(times, np.memmap) or times.filename is None:
        return None
    folder = Path(times.filename).parent
    whole = (folder / ABOUT).is_file() and len(np.load(times.filename, mmap_mode="r")) == len(times)
    return folder if whole else None
