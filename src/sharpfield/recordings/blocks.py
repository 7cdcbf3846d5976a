"""Files read block by block, with a clear message when that fails."""

from collections.abc import Iterator
from pathlib import Path

from sharpfield.core.errors import CaptureError

BLOCK = 2**21
"""Bytes read at once; small enough to stay in the processor's cache until they are decoded."""


def head(path: Path, count: int) -> bytes:
    """The first bytes of a file, `count` at most.

    Raises:
        CaptureError: There is no such file, or it cannot be read.
    """
    if not path.is_file():
        raise CaptureError("recording not found", where=path)
    for block in blocks(path, 0, count):
        return block
    return b""


def blocks(path: Path, start: int = 0, count: int = BLOCK) -> Iterator[bytes]:
    """A file from the byte `start` to its end, `count` bytes at a time.

    Raises:
        CaptureError: It cannot be read.
    """
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(start)
            while block := file.read(count):
                yield block
    except OSError as error:
        raise CaptureError("cannot read the recording", where=path, got=error) from None
