"""Reading files block by block, and decompressing blocks with a limit on the output size."""

import bz2
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError, need

BLOCK = 2**21
"""Bytes read at a time; small enough to stay in the CPU cache until they are decoded."""


ZIP = b"PK\x03\x04"
"""Signature of zip archives."""


def read_head(path: Path, count: int) -> bytes:
    """Read the first bytes of a file, `count` at most.

    Raises:
        CaptureError: There is no such file, or it cannot be read.
    """
    if not path.is_file():
        raise CaptureError("recording not found", where=path)
    for block in read_blocks(path, 0, count):
        return block
    return b""


def read_blocks(path: Path, start: int = 0, count: int = BLOCK) -> Iterator[bytes]:
    """Read a file from the byte `start` to its end, `count` bytes at a time.

    Raises:
        CaptureError: The file cannot be read.
    """
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(start)
            while block := file.read(count):
                yield block
    except OSError as error:
        raise CaptureError("cannot read the recording", where=path, got=error) from None


def zip_holds(path: Path, head: bytes, suffix: str) -> bool:
    """Whether a file is a zip archive with a member whose name ends in `suffix`."""
    if not head.startswith(ZIP):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(suffix) for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, NotImplementedError):
        return False


Bytes = bytes | memoryview

MAX_BLOCK = 2**28
"""Most bytes of a decompressed block (16 million events); no valid one is larger."""

OUTPUT_STEP = 2**22
"""Bytes decompressed at a time: decompressors allocate as much as is asked for."""


class DamagedData(ValueError):
    """A part of a file is invalid. Readers skip it and count it in their log."""


def decompress(data: Bytes, compression: str) -> Bytes:
    """Decompress a block.

    Args:
        data: One complete frame.
        compression: "none", "bz2", "lz4" (frames, not bare blocks) or "zstd".

    Raises:
        DamagedData: The block is truncated, invalid or larger than `MAX_BLOCK`, or the compression
            is unknown.
        MissingExtra: The package for this compression is not installed.
    """
    if compression not in _DECOMPRESSORS:
        raise DamagedData(f"compression {compression!r}")
    return _DECOMPRESSORS[compression](data)


def _lz4(data: Bytes) -> bytes:
    frame: Any = need("lz4.frame", extra="io", purpose="reading a recording compressed with LZ4")
    return _decompressed(frame.LZ4FrameDecompressor(), data, RuntimeError)


def _zstd(data: Bytes) -> bytes:
    zstd: Any = need(
        "zstandard", extra="io", purpose="reading a recording compressed with Zstandard"
    )
    try:
        with zstd.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as reader:
            found = _joined(iter(lambda: reader.read(OUTPUT_STEP), b""))
    except zstd.ZstdError as error:
        raise DamagedData(str(error)) from None
    if not found:
        raise DamagedData("a truncated block")
    return found


def _decompressed(decompressor: Any, data: Bytes, failure: type[Exception]) -> bytes:
    def parts() -> Iterator[bytes]:
        yield decompressor.decompress(data, max_length=OUTPUT_STEP)
        while not decompressor.eof:
            if decompressor.needs_input:
                raise DamagedData("a truncated block")
            yield decompressor.decompress(b"", max_length=OUTPUT_STEP)

    try:
        return _joined(parts())
    except (failure, EOFError) as error:
        raise DamagedData(str(error)) from None


def _joined(parts: Iterator[bytes]) -> bytes:
    found: list[bytes] = []
    size = 0
    for part in parts:
        size += len(part)
        if size > MAX_BLOCK:
            raise DamagedData("a block that grows without end")
        found.append(part)
    return found[0] if len(found) == 1 else b"".join(found)


_DECOMPRESSORS: dict[str, Callable[[Bytes], Bytes]] = {
    "none": lambda data: data,
    "bz2": lambda data: _decompressed(bz2.BZ2Decompressor(), data, OSError),
    "lz4": _lz4,
    "zstd": _zstd,
}
