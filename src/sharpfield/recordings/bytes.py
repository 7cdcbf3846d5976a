"""Files read block by block, with a clear message when that fails.

Compressed blocks of a file, unpacked without trusting what they say of themselves.
"""

import bz2
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError, need

BLOCK = 2**21
"""Bytes read at once; small enough to stay in the CPU's cache until they are decoded."""


ZIP = b"PK\x03\x04"
"""What zip archives begin with."""


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


def zip_holds(path: Path, head: bytes, suffix: str) -> bool:
    """Whether a file is a zip archive with a member whose name ends so."""
    if not head.startswith(ZIP):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(suffix) for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, NotImplementedError):
        return False


Bytes = bytes | memoryview

LIMIT = 2**28
"""No sound block is larger once unpacked (16 million events)."""

PORTION = 2**22
"""Bytes unpacked at once: asking for more makes room for more."""


class Damaged(ValueError):
    """A part of a file is not what it should be; whoever reads the file skips it and counts."""


def unpacked(data: Bytes, packing: str) -> Bytes:
    """The block itself.

    Args:
        data: One whole frame.
        packing: "none", "bz2", "lz4" (frames, not bare blocks) or "zstd".

    Raises:
        Damaged: It is torn, wrong, or larger than `LIMIT`; or no such packing is known.
        MissingExtra: The package that unpacks it is not installed.
    """
    if packing not in _UNPACK:
        raise Damaged(f"packing {packing!r}")
    return _UNPACK[packing](data)


def _none(data: Bytes) -> Bytes:
    return data


def _bz2(data: Bytes) -> bytes:
    return _limited(bz2.BZ2Decompressor(), data, OSError)


def _lz4(data: Bytes) -> bytes:
    frame: Any = need("lz4.frame", extra="io", purpose="reading a recording packed with LZ4")
    return _limited(frame.LZ4FrameDecompressor(), data, RuntimeError)


def _zstd(data: Bytes) -> bytes:
    zstd: Any = need("zstandard", extra="io", purpose="reading a recording packed with Zstandard")
    try:
        with zstd.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as reader:
            found = _collected(iter(lambda: reader.read(PORTION), b""))
    except zstd.ZstdError as error:
        raise Damaged(str(error)) from None
    if not found:
        raise Damaged("a torn block")
    return found


def _limited(decompressor: Any, data: Bytes, failure: type[Exception]) -> bytes:
    def portions() -> Iterator[bytes]:
        yield decompressor.decompress(data, max_length=PORTION)
        while not decompressor.eof:
            if decompressor.needs_input:
                raise Damaged("a torn block")
            yield decompressor.decompress(b"", max_length=PORTION)

    try:
        return _collected(portions())
    except (failure, EOFError) as error:
        raise Damaged(str(error)) from None


def _collected(portions: Iterator[bytes]) -> bytes:
    found: list[bytes] = []
    size = 0
    for portion in portions:
        size += len(portion)
        if size > LIMIT:
            raise Damaged("a block that grows without end")
        found.append(portion)
    return found[0] if len(found) == 1 else b"".join(found)


_UNPACK: dict[str, Callable[[Bytes], Bytes]] = {
    "none": _none,
    "bz2": _bz2,
    "lz4": _lz4,
    "zstd": _zstd,
}
