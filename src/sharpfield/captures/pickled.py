"""Arrays in pickled files, without running what such a file may hold.

A pickle is a program for building objects, and may name any function to call. Here it may name
only what arrays of numbers are built from; everything else is refused before it is called. Even so
such a file is opened only when the user says so.
"""

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.errors import CaptureError

BUILDERS = {
    (f"numpy{core}.{module}", name)
    for core in (".core", "._core")
    for module, name in (
        ("multiarray", "_reconstruct"),
        ("multiarray", "scalar"),
        ("numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")}
"""What numpy's own pickles of arrays call; the last turns text into bytes."""


def load_pickled(path: Path) -> list[Shaped[np.ndarray, "..."]]:
    """The arrays of a `.pkl` file, or of an `.npy` file of objects.

    Raises:
        CaptureError: The file is missing or malformed, or holds anything but arrays of numbers.
    """
    try:
        with path.open("rb") as file:
            found = _objects(file) if path.suffix == ".npy" else _Arrays(file).load()
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except (pickle.UnpicklingError, ValueError, EOFError, TypeError, AttributeError) as error:
        raise CaptureError(
            "cannot read arrays from a pickled file",
            where=path,
            got=error,
            do="save it as plain numbers with np.savez, one array for each camera",
        ) from None
    arrays: list[Any] = list(found) if isinstance(found, list | tuple | np.ndarray) else [found]
    if not all(isinstance(array, np.ndarray) and array.dtype.kind in "iufb" for array in arrays):
        raise CaptureError("a pickled file holds more than arrays of numbers", where=path)
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
    """Refuses to name anything but what arrays are built from."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in BUILDERS:
            raise pickle.UnpicklingError(f"the file names {module}.{name}, which is no array")
        return super().find_class(module, name)
