"""npy and npz files, loaded with a clear message when they are missing, cut off or pickled."""

import zipfile
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.errors import CaptureError

Array = Shaped[np.ndarray, "..."]

BLOCK = 1 << 20
"""Bytes read at once."""

PICKLED = "allow_pickle"
"""What numpy's message mentions when a file holds pickled objects."""


def load_array(path: Path) -> Array:
    """The array of an npy file.

    Raises:
        CaptureError: The file is missing, malformed, or holds pickled Python objects.
    """
    loaded = _load(path)
    if not isinstance(loaded, np.ndarray):
        raise CaptureError("expected a single array", where=path, got="an npz archive")
    return loaded


def load_arrays(path: Path) -> dict[str, Array]:
    """All arrays of an npz file, by name.

    Raises:
        CaptureError: The file is missing, malformed, or holds pickled Python objects.
    """
    loaded = _load(path)
    if isinstance(loaded, np.ndarray):
        raise CaptureError("expected an npz archive of arrays", where=path, got="a single array")
    with loaded:
        try:
            return {name: loaded[name] for name in loaded.files}
        except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise _unreadable(path, error) from None


class Column:
    """A column of numbers that grows in a file of its own, which goes into an npz file later."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._kind = np.dtype(np.uint8)
        self._count = 0

    def append(self, values: Shaped[np.ndarray, "n"]) -> None:
        """Add numbers; what comes first decides the type."""
        if not self._count:
            self._kind = values.dtype
        with self._path.open("ab") as file:
            file.write(values.astype(self._kind, copy=False).tobytes())
        self._count += len(values)

    def blocks(self) -> Iterator[bytes]:
        """The whole column as an npy file, piece by piece."""
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
    """Write an npz file; unlike `np.savez` it takes any name, also `file`."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if isinstance(array, Column):
                    member.writelines(array.blocks())
                else:
                    np.lib.format.write_array(member, array, allow_pickle=False)


def _load(path: Path) -> "Array | np.lib.npyio.NpzFile":
    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> CaptureError:
    if PICKLED in str(error):
        return CaptureError(
            "file holds pickled Python objects, which may run code when loaded",
            where=path,
            do="save it as plain numbers with np.save or np.savez",
        )
    return CaptureError("cannot read arrays", where=path, got=error, do="copy or write it again")
