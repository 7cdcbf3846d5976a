"""Writing events chunk by chunk, in our superset of the DSEC layout or as the file's suffix says.

    .h5     our own, described below: it states its units and sensor resolution
    .npz    arrays x, y, t (us), p (-1 or +1) at the root, and tick_ns (1000), width, height
    .csv    a header `t_us,x,y,p`, then one event per line; p is -1 or +1
    .raw    Prophesee's EVT3, see `storage.evt_writer`

In every format the file appears whole, at the end, or not at all, and one chunk is in memory. Our
own layout:

    events/{x, y, t, p}     t in us after t_offset, p 0 or 1; chunks of 65 536 events
    events/track            the camera of an event, where there are several
    ms_to_idx               index of the first event at or after each ms since t_offset
    t_offset                us
    site_colour/{x, y, channel}     only for rectified events of a colour sensor
    attributes              format, version, tick_ns, width, height, bayer, tracks

Blosc (zstd 1, byte shuffle) compresses 20 M real events to 1.7 bytes each and reads a random 10 ms
window in about 3 ms; without `hdf5plugin` it is gzip 1 with shuffle, which every HDF5 reads.

A long recording is written in parts, which remain when writing is interrupted. `join_events` joins
them without decompressing: HDF5 chunks are copied as they are.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
from jaxtyping import UInt64

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing
from sharpfield.storage.arrays import Column, write_arrays
from sharpfield.storage.event_file import CHUNK, expect_later
from sharpfield.storage.evt_writer import writing_evt
from sharpfield.storage.hdf5 import compression_plugin

MS_TO_IDX = "ms_to_idx"
FORMAT, VERSION = "sharpfield-events", 1
ROWS = 65_536
"""Events per HDF5 chunk, which are decompressed together."""

SHORT_US = 2**32 - 1
"""Longest recording (71 minutes) whose times fit into 4 bytes."""


class EventWriter:
    """Appends events to an open file; made by `writing_events`."""

    def __init__(
        self,
        file: h5py.File,
        path: Path,
        like: EventStream,
        *,
        long: bool,
        origin_us: int | None = None,
    ) -> None:
        self._file, self._path, self._like, self._long = file, path, like, long
        self._count = 0
        self._origin_us = origin_us
        self._offset_us = origin_us or 0
        self._last_us: int | None = None
        self._columns: dict[str, h5py.Dataset] = {}
        self._ms_to_idx = file.create_dataset(
            MS_TO_IDX, (0,), np.uint64, maxshape=(None,), chunks=(ROWS,), **_compression()
        )

    def append(self, events: EventStream) -> None:
        """Append events that are later than all earlier ones.

        Raises:
            CaptureError: They are earlier or invalid.
        """
        if not len(events):
            return
        expect_later(events, self._last_us, self._path)
        if self._last_us is None and self._origin_us is None:
            self._offset_us = int(events.t_us[0]) // 1000 * 1000
        since = events.t_us - self._offset_us
        if not self._long and since[-1] > SHORT_US:
            raise CaptureError(
                "the recording is longer than `span_us`",
                where=self._path,
                got=f"{since[-1] / 6e7:.1f} minutes",
                do="leave `span_us` out",
            )
        columns = {"x": events.x, "y": events.y, "t": since, "p": (events.p > 0).astype(np.uint8)}
        if events.track is not None:
            columns["track"] = events.track
        for name, values in columns.items():
            if name not in self._columns:
                kind = ("u8" if self._long else "u4") if name == "t" else values.dtype
                self._columns[name] = self._file.create_dataset(
                    f"events/{name}", (0,), kind, maxshape=(None,), chunks=(ROWS,), **_compression()
                )
            self._extend(self._columns[name], values)
        known = len(self._ms_to_idx)
        ms = np.arange(known, since[-1] // 1000 + 1)
        self._extend(self._ms_to_idx, self._count + np.searchsorted(since, ms * 1000))
        self._count += len(events)
        self._last_us = int(events.t_us[-1])

    def finish(self) -> None:
        """Write what is known only at the end."""
        if self._last_us is None:
            for name, kind in (("x", "u2"), ("y", "u2"), ("t", "u4"), ("p", "u1")):
                self._file.create_dataset(f"events/{name}", (0,), kind)
            if self._like.track is not None:
                self._file.create_dataset("events/track", (0,), self._like.track.dtype)
        self._file["t_offset"] = np.int64(self._offset_us)

    @staticmethod
    def _extend(column: h5py.Dataset, values: np.ndarray) -> None:
        start = len(column)
        column.resize((start + len(values),))
        column[start:] = values


@contextmanager
def writing_events(
    path: Path | str, like: EventStream, *, span_us: int | None = None, origin_us: int | None = None
) -> Iterator[EventWriter]:
    """A writer for `path`; the file appears when the block ends well, whole, or not at all.

    Args:
        path: The file, replaced if it exists.
        like: Any stream of the same sensor (it may be empty): its resolution and colour filter
            are written.
        span_us: Duration of the recording, if known; times of a short one take 4 bytes.
        origin_us: Origin of the stored times, not after the first event; by default the whole ms
            before it.
    """
    path = Path(path)
    with replacing(path) as temporary:
        with h5py.File(temporary, "w", libver=("v110", "latest")) as file:
            file.attrs.update(
                format=FORMAT,
                version=VERSION,
                tick_ns=1000,
                width=like.width,
                height=like.height,
                bayer=like.bayer,
                tracks=like.tracks,
            )
            if like.site_colour is not None:
                for name in ("x", "y", "channel"):
                    file[f"site_colour/{name}"] = getattr(like.site_colour, name)
            long = span_us is None or span_us > SHORT_US - 1000
            writer = EventWriter(file, path, like, long=long, origin_us=origin_us)
            yield writer
            writer.finish()


def write_events(path: Path | str, events: EventStream) -> None:
    """Write a whole stream, which may be memory-mapped."""
    span_us = int(events.t_us[-1] - events.t_us[0]) if len(events) else 0
    with writing_events(path, events[:0], span_us=span_us) as writer:
        for first in range(0, len(events), CHUNK):
            writer.append(events[first : first + CHUNK])


def _compression() -> Mapping[str, Any]:
    plugin = compression_plugin()
    if plugin is not None:
        return plugin.Blosc(cname="zstd", clevel=1, shuffle=plugin.Blosc.SHUFFLE)
    return {"compression": "gzip", "compression_opts": 1, "shuffle": True}


def join_events(path: Path, parts: Sequence[Path]) -> None:
    """Join files of consecutive events; the new file appears whole or not at all.

    Args:
        path: The file, replaced if it exists.
        parts: At least one file, in the order of time, all written with the same `origin_us` and
            `span_us`; all but the last hold a multiple of `ROWS` events.
    """
    with ExitStack() as opened:
        files: list[Any] = [opened.enter_context(h5py.File(part, "r")) for part in parts]
        counts = [len(file["events/t"]) for file in files]
        assert not any(count % ROWS for count in counts[:-1]), f"parts of {counts} events"
        temporary = opened.enter_context(replacing(path))
        with h5py.File(temporary, "w", libver=("v110", "latest")) as joined:
            joined.attrs.update(files[0].attrs)
            joined.create_group("events")
            for name in files[0]["events"]:
                _join_column(joined, name, [file["events"][name] for file in files])
            for name in set(files[0]) - {"events", MS_TO_IDX}:
                files[0].copy(name, joined)
            joined.create_dataset(
                MS_TO_IDX, data=_joined_ms_to_idx(files, counts), chunks=(ROWS,), maxshape=(None,)
            )


def _join_column(joined: h5py.File, name: str, columns: Sequence[h5py.Dataset]) -> None:
    first = columns[0]
    total = sum(len(column) for column in columns)
    space = h5py.h5s.create_simple((total,), (h5py.h5s.UNLIMITED,))
    settings = first.id.get_create_plist()  # chunks and filters as in the parts
    made = h5py.h5d.create(joined["events"].id, name.encode(), first.id.get_type(), space, settings)
    base = 0
    for column in columns:
        for i in range(column.id.get_num_chunks()):
            offset = column.id.get_chunk_info(i).chunk_offset
            mask, data = column.id.read_direct_chunk(offset)
            made.write_direct_chunk((base + offset[0],), data, mask)
        base += len(column)


def _joined_ms_to_idx(files: Sequence[Any], counts: Sequence[int]) -> UInt64[np.ndarray, "m"]:
    """Index of the first event at or after each ms; each part has it for its own time."""
    known, base = [np.empty(0, np.uint64)], 0
    for file, count in zip(files, counts, strict=True):
        first_ms = sum(len(one) for one in known)
        known.append(file[MS_TO_IDX][first_ms:] + np.uint64(base))
        base += count
    return np.concatenate(known)


Append = Callable[[EventStream], None]
"""Appends events that are later than all earlier ones."""


@contextmanager
def exporting_events(path: Path, like: EventStream) -> Iterator[Append]:
    """A function that appends events to a new file.

    Args:
        path: Ends in .h5, .npz, .csv or .raw.
        like: Any stream of the same sensor; it may be empty.

    Raises:
        OptionError: The name has another suffix.
    """
    expect_format(path)
    with FORMATS[path.suffix](path, like) as append:
        yield append


def expect_format(path: Path) -> None:
    """Check that the suffix of a file name is a format of events.

    Raises:
        OptionError: It is not.
    """
    if path.suffix not in FORMATS:
        raise OptionError(
            "unknown format of events", got=path, do=f"name a file with {', '.join(FORMATS)}"
        )


@contextmanager
def _native(path: Path, like: EventStream) -> Iterator[Append]:
    with writing_events(path, like) as writer:
        yield writer.append


@contextmanager
def _arrays(path: Path, like: EventStream) -> Iterator[Append]:
    about = {"tick_ns": 1000, "width": like.width, "height": like.height}
    with replacing(path) as temporary, TemporaryDirectory(dir=path.parent, prefix=".") as folder:
        columns = {name: Column(Path(folder) / name) for name in ("x", "y", "t", "p")}

        def append(events: EventStream) -> None:
            for name, column in columns.items():
                column.append(getattr(events, "t_us" if name == "t" else name))

        append(like[:0])
        yield append
        numbers = {name: np.array(value) for name, value in about.items()}
        write_arrays(temporary, columns | numbers)


@contextmanager
def _text(path: Path, like: EventStream) -> Iterator[Append]:
    with replacing(path) as temporary, temporary.open("w") as file:
        file.write("t_us,x,y,p\n")

        def append(events: EventStream) -> None:
            rows = np.stack([events.t_us, events.x, events.y, events.p], -1)
            np.savetxt(file, rows, "%d", delimiter=",")

        yield append


@contextmanager
def _raw(path: Path, like: EventStream) -> Iterator[Append]:
    with writing_evt(path, like) as writer:
        yield writer.append


FORMATS = {".h5": _native, ".npz": _arrays, ".csv": _text, ".raw": _raw}
