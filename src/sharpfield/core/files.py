"""Atomic writing: to a temporary name first, which then replaces the target."""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: Path) -> Generator[Path, None, None]:
    """A temporary file beside `path` that replaces it when the block ends without an error.

    The temporary name keeps the suffix, which many writers use to choose the format. When the
    block raises, the temporary file is removed and whatever was at `path` stays as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(suffix=path.suffix, prefix=f".{path.stem}-", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, about: Any, *, allow_nan: bool = True) -> None:
    """Write plain values for people and programs to read, in place of what was at `path`."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(about, indent=2, allow_nan=allow_nan) + "\n")


@contextlib.contextmanager
def replacing_folder(path: Path) -> Generator[Path, None, None]:
    """A temporary folder beside `path` that replaces it when the block ends without an error.

    An earlier folder at `path` is moved aside first and deleted only once the new one is there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    old = temporary.with_name(temporary.name + "-old")
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        if path.exists():
            path.rename(old)
        temporary.rename(path)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if old.exists() and not path.exists():
            old.rename(path)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
