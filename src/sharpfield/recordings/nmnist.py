"""The data sets N-MNIST and N-Caltech101: five bytes per event, one small file per picture.

    x, 1 byte; y, 1 byte; polarity, 1 bit; time in us, 23 bits, most significant byte first

The file says no size. A row of 240 is no row: such a record says that 2^13 us have gone by.

Source: Orchard et al., *Converting static image datasets to spiking neuromorphic datasets using
saccades* (Frontiers in Neuroscience 2015), and the reader its authors publish.
"""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.blocks import blocks, head
from sharpfield.recordings.pieces import Piece, joined, known_size
from sharpfield.recordings.recording import Chunks, Recording, Trouble

RECORD = 5
"""Bytes of an event."""

SIZES = {"nmnist": (34, 34), "ncaltech101": (240, 180)}
"""Width and height of each data set; pictures of N-Caltech101 differ, none is larger."""

NO_ROW, PAUSE_US = 240, 2**13
"""Row of a record that is no event, and the time it stands for."""


def open_nmnist(path: Path | str, *, size: tuple[int, int] | None = None) -> Recording:
    """Open a file of N-MNIST or N-Caltech101.

    Args:
        path: Of the file.
        size: Width and height of the sensor; see `SIZES`.

    Raises:
        CaptureError: It is no such file, or the size is not given.
    """
    path = Path(path)
    trouble = Trouble()
    if len(head(path, RECORD)) < RECORD:
        raise CaptureError(
            "the file holds no event", where=path, got="less than 5 bytes", do="copy it again"
        )
    size = known_size(None, size, path)

    def pieces(noted: Trouble) -> Iterator[Piece]:
        rest, paused_us = b"", 0
        for block in chain(blocks(path), [b""]):
            rest += block
            records = np.frombuffer(rest, np.uint8, len(rest) // RECORD * RECORD)
            rest = rest[len(records) :]
            x, y, high, middle, low = records.reshape(-1, RECORD).T.astype(np.int64)
            pauses = np.cumsum(y == NO_ROW) * PAUSE_US + paused_us
            paused_us = int(pauses[-1]) if len(pauses) else paused_us
            t_us = ((high & 0x7F) << 16 | middle << 8 | low) + pauses
            p = np.where(high >> 7, 1, -1).astype(np.int8)
            yield Piece(x.astype(np.uint16), y.astype(np.uint16), t_us, p)[y != NO_ROW]
        noted.note("torn records", int(len(rest) > 0))

    def events() -> Chunks:
        noted = trouble.anew("events")
        return joined(pieces(noted), size, where=path, trouble=noted)

    return Recording(path, "N-MNIST", size=size, events=events, trouble=trouble)
