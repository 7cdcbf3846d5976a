"""npy and npz files, loaded with a clear message when they are missing, cut off or pickled."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.errors import CaptureError

Array = Shaped[np.ndarray, "..."]

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


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write an npz file; unlike `np.savez` it takes any name, also `file`."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
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
