"""npy and npz files with clear errors, arrays of pickled files, and a check before replacing.

A pickle is a program that builds objects, and may name any function to call. Here it may only name
what builds arrays of numbers; everything else is refused before it is called. Even so such a file
is opened only when the user asks for it.
"""

import pickle
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.errors import CaptureError

Array = Shaped[np.ndarray, "..."]

BLOCK = 1 << 20
"""Bytes that are read at once."""

PICKLED = ("allow_pickle", "Python objects")
"""Parts of numpy's error messages for files of pickled objects."""

UNREADABLE = (
    *(OSError, EOFError, ValueError, RuntimeError, SyntaxError, tokenize.TokenError),
    *(zipfile.BadZipFile, zlib.error),
)
"""Exceptions that reading a part of a damaged file may raise."""


def load_array(path: Path, *, mapped: bool = False) -> Array:
    """Read the array of an npy file, or map it to memory.

    Raises:
        CaptureError: The file is missing, malformed, or holds pickled Python objects.
    """
    loaded = _load(path, mapped=mapped)
    if not isinstance(loaded, np.ndarray):
        raise CaptureError(
            "expected a single array", where=path, got="an npz archive", do="save it with np.save"
        )
    return loaded


def load_arrays(path: Path) -> dict[str, Array]:
    """Read all arrays of an npz file, by name.

    Raises:
        CaptureError: The file is missing, malformed, or holds pickled Python objects.
    """
    loaded = _load(path)
    if isinstance(loaded, np.ndarray):
        raise CaptureError(
            "expected an npz archive", where=path, got="a single array", do="save it with np.savez"
        )
    with loaded:
        try:
            return {name: loaded[name] for name in loaded.files}
        except UNREADABLE as error:
            raise _unreadable(path, error) from None


class Column:
    """A column of numbers that is appended to in a temporary file, for an npz file later."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._kind = np.dtype(np.uint8)
        self._count = 0

    def append(self, values: Shaped[np.ndarray, "n"]) -> None:
        """Append numbers; the first ones decide the type."""
        if not self._count:
            self._kind = values.dtype
        with self._path.open("ab") as file:
            file.write(values.astype(self._kind, copy=False).tobytes())
        self._count += len(values)

    def blocks(self) -> Iterator[bytes]:
        """The bytes of the column as an npy file, block by block."""
        header = BytesIO()
        about = {
            "descr": np.lib.format.dtype_to_descr(self._kind),
            "fortran_order": False,
            "shape": (self._count,),
        }
        np.lib.format.write_array_header_1_0(header, about)
        yield header.getvalue()
        with self._path.open("rb") as file:
            yield from iter(lambda: file.read(BLOCK), b"")


def write_arrays(path: Path, arrays: Mapping[str, Array | Column]) -> None:
    """Write an npz file; unlike `np.savez`, any name is allowed, also `file`."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if isinstance(array, Column):
                    member.writelines(array.blocks())
                else:
                    np.lib.format.write_array(member, array, allow_pickle=False)


def _load(path: Path, *, mapped: bool = False) -> "Array | np.lib.npyio.NpzFile":
    try:
        return np.load(path, mmap_mode="r" if mapped else None, allow_pickle=False)
    except FileNotFoundError:
        raise CaptureError("file not found", where=path, do="check the path") from None
    except UNREADABLE as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> CaptureError:
    if any(part in str(error) for part in PICKLED):
        return CaptureError(
            "file holds pickled Python objects, which may run code when loaded",
            where=path,
            do="save it as plain numbers with np.save or np.savez",
        )
    return CaptureError("cannot read arrays", where=path, got=error, do="copy or write it again")


BUILDERS = {
    (f"numpy{core}.{module}", name)
    for core in (".core", "._core")
    for module, name in (
        ("multiarray", "_reconstruct"),
        ("multiarray", "scalar"),
        ("numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")}
"""What numpy's own pickles of arrays call; the last converts text to bytes."""


def load_pickled(path: Path) -> list[Array]:
    """Read the arrays of a `.pkl` file, or of an `.npy` file of objects.

    Raises:
        CaptureError: The file is missing or malformed, or holds anything but arrays of numbers.
    """
    try:
        with path.open("rb") as file:
            found = _objects(file) if path.suffix == ".npy" else _Arrays(file).load()
    except FileNotFoundError:
        raise CaptureError("file not found", where=path, do="check the path") from None
    except (pickle.UnpicklingError, ValueError, EOFError, TypeError, AttributeError) as error:
        raise CaptureError(
            "cannot read arrays from a pickled file",
            where=path,
            got=error,
            do="save it as plain numbers with np.savez, one array for each camera",
        ) from None
    arrays: list[Any] = list(found) if isinstance(found, list | tuple | np.ndarray) else [found]
    if not all(isinstance(array, np.ndarray) and array.dtype.kind in "iufb" for array in arrays):
        raise CaptureError(
            "a pickled file holds more than arrays of numbers",
            where=path,
            do="save the arrays alone, with np.savez",
        )
    return arrays


def _objects(file: BinaryIO) -> Sequence[Any] | np.ndarray:
    """The objects after the header of an `.npy` file."""
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        header = np.lib.format.read_array_header_2_0
    _, _, kind = header(file)
    if kind.hasobject:
        return _Arrays(file).load()
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


class _Arrays(pickle.Unpickler):
    """Refuses every name but those that build arrays."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in BUILDERS:
            raise pickle.UnpicklingError(f"the file calls {module}.{name}, which builds no array")
        return super().find_class(module, name)


def expect_replaceable(folder: Path, recognise: Callable[[Path], bool]) -> None:
    """Check that a folder may be replaced: it is new, empty, or holds a capture.

    Args:
        folder: The folder that will be replaced.
        recognise: Whether a folder holds a capture of the layout to be written.

    Raises:
        CaptureError: It holds something else.
    """
    if not folder.exists() or (
        folder.is_dir() and (recognise(folder) or not any(folder.iterdir()))
    ):
        return
    raise CaptureError(
        "will not replace what is not a capture",
        where=folder,
        do="choose another folder, or empty this one",
    )
