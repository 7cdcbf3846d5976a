"""The event index on disk: built once beside a capture, memory-mapped ever after.

The folder holds one `.npy` file per array and `index.json`, which says what it was built from. It
appears whole or not at all, and streams larger than memory are sorted a range of sites at a time.
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.events.index import EventIndex, count, place
from sharpfield.events.sites import find_sites

FORMAT = 1
"""Number of the folder's layout; an index of another number is built anew."""

HELD = 2**26
"""Events sorted in memory at a time: 9 bytes each."""


def file_key(*paths: Path) -> str:
    """Names the content of files by their sizes and times of change, without reading them."""
    stats = [(path.name, path.stat()) for path in paths]
    return " ".join(f"{name}:{stat.st_size}:{stat.st_mtime_ns}" for name, stat in stats)


def index_on_disk(events: EventStream, folder: Path, *, key: str, held: int = HELD) -> EventIndex:
    """The memory-mapped index of a stream; built first unless `folder` has it already.

    Args:
        events: The stream; its arrays may be memory-mapped.
        folder: Where the index is, or will be.
        key: Names the stream, see `file_key`. An index with another key is replaced.
        held: How many events may be in memory while sorting; a single busier site is allowed.

    Raises:
        CaptureError: See `build`.
    """
    found = _open(folder, key, events.tracks)
    if found is not None:
        return found
    site_xy, site_of = find_sites(events)
    offset = count(events, site_of, len(site_xy))
    with replacing_folder(folder) as fresh:
        np.save(fresh / "site_xy.npy", site_xy)
        np.save(fresh / "offset.npy", offset)
        t_file = _created(fresh / "t_us.npy", np.int64, len(events))
        p_file = _created(fresh / "p.npy", np.int8, len(events))
        for first, last in site_ranges(offset, held):
            part = slice(offset[first], offset[last])
            t_file[part], p_file[part] = place(events, site_of, offset, first=first, last=last)
        t_file.flush()
        p_file.flush()
        (fresh / "index.json").write_text(json.dumps({"format": FORMAT, "key": key}) + "\n")
    opened = _open(folder, key, events.tracks)
    assert opened is not None, f"the index just written to {folder} cannot be read"
    return opened


def site_ranges(offset: Int64[np.ndarray, "o"], held: int) -> list[tuple[int, int]]:
    """Consecutive ranges of sites with at most `held` events each, or with a single site."""
    ranges: list[tuple[int, int]] = []
    first, sites = 0, len(offset) - 1
    while first < sites:
        last = int(np.searchsorted(offset, int(offset[first]) + held, side="right")) - 1
        last = min(max(last, first + 1), sites)
        ranges.append((first, last))
        first = last
    return ranges


def _open(folder: Path, key: str, tracks: int) -> EventIndex | None:
    try:
        about = json.loads((folder / "index.json").read_text())
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError):
        return None
    if about != {"format": FORMAT, "key": key}:
        return None
    names = ("site_xy", "offset", "t_us", "p")
    arrays = [np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in names]
    return EventIndex(*(np.asarray(array) for array in arrays), tracks=tracks)


def _created(path: Path, dtype: type[np.generic], length: int) -> np.memmap:
    return np.lib.format.open_memmap(path, "w+", np.dtype(dtype), (length,))
