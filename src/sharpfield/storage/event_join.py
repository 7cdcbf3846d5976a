"""Several files of our own, of events that follow each other, made one.

Whoever writes a long recording writes it in parts, so that what is written stays when the writing
is interrupted. The parts are joined without unpacking them: HDF5 chunks are copied as they are.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import UInt64

from sharpfield.core.files import replacing
from sharpfield.storage.event_writer import ROWS

MARKS = "ms_to_idx"


def join_events(path: Path, parts: Sequence[Path]) -> None:
    """Write one file of several; it appears whole or not at all, and the parts stay.

    Args:
        path: Of the file, replaced if it exists.
        parts: At least one, in the order of time, all written with the same `origin_us` and
            `span_us`; all but the last hold a multiple of `event_writer.ROWS` events.
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
            for name in set(files[0]) - {"events", MARKS}:
                files[0].copy(name, joined)
            joined.create_dataset(
                MARKS, data=_marks(files, counts), chunks=(ROWS,), maxshape=(None,)
            )


def _join_column(joined: h5py.File, name: str, columns: Sequence[h5py.Dataset]) -> None:
    first = columns[0]
    total = sum(len(column) for column in columns)
    space = h5py.h5s.create_simple((total,), (h5py.h5s.UNLIMITED,))
    packing = first.id.get_create_plist()  # chunks and filters, as they were packed
    made = h5py.h5d.create(
        joined["events"].id,
        name.encode(),
        first.id.get_type(),
        space,
        packing,
    )
    base = 0
    for column in columns:
        for i in range(column.id.get_num_chunks()):
            offset = column.id.get_chunk_info(i).chunk_offset
            mask, data = column.id.read_direct_chunk(offset)
            made.write_direct_chunk((base + offset[0],), data, mask)
        base += len(column)


def _marks(files: Sequence[Any], counts: Sequence[int]) -> UInt64[np.ndarray, "m"]:
    """Number of the first event at or after each ms: each part tells it for its own time."""
    known, base = [np.empty(0, np.uint64)], 0
    for file, count in zip(files, counts, strict=True):
        told = sum(len(marks) for marks in known)
        known.append(file[MARKS][told:] + np.uint64(base))
        base += count
    return np.concatenate(known)
