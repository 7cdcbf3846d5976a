"""The disk cache: what takes long to compute from large files, stored beside them.

An entry is a file or folder `cache/NAME-KEY`. The key changes whenever something that the entry
depends on changes: names, sizes and times of change of the source files, and all parameters. An
entry appears whole or not at all. Where neither the folder of the files nor the user's own cache
can be written, nothing is cached. Everything in a cache is derived: delete it when you like.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing, replacing_folder
from sharpfield.storage.arrays import load_arrays, write_arrays

VERSION = 2
"""Increase it when entries would be written in another form: older ones are then left alone."""

Arrays = Mapping[str, Shaped[np.ndarray, "..."]]


def cache_folder(source: Path) -> Path:
    """The folder for entries that are derived from a file or folder.

    It is `cache/` beside `source`, or a folder of the user's own cache if that cannot be written.
    """
    beside = source.resolve().parent
    if os.access(beside, os.W_OK):
        return beside / "cache"
    digest = hashlib.blake2b(str(beside).encode(), digest_size=8).hexdigest()
    return Path.home() / ".cache" / "sharpfield" / digest


def cache_key(sources: Iterable[Path], *parameters: Any) -> str:
    """A key of source files and of parameters, which are JSON values or arrays.

    Files are identified by name, size and time of change; they are not read.
    """
    stats = [(path.name, path.stat()) for path in sources]
    files = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    plain = [one for one in parameters if not isinstance(one, np.ndarray)]
    key = hashlib.blake2b(digest_size=10)
    key.update(json.dumps([VERSION, files, plain], sort_keys=True).encode())
    for array in parameters:
        if isinstance(array, np.ndarray):
            key.update(f"{array.dtype}{array.shape}".encode())
            key.update(np.ascontiguousarray(array).data)
    return key.hexdigest()


def cached(
    folder: Path,
    name: str,
    key: str,
    write: Callable[[Path], object],
    *,
    suffix: str = "",
    replaces: bool = False,
) -> Path | None:
    """The path of an entry of the cache, which is written first unless it exists.

    Args:
        folder: The cache, see `cache_folder`.
        name: Of the entry.
        key: See `cache_key`.
        write: Fills the temporary file or folder that it is given.
        suffix: Of a file; without one the entry is a folder.
        replaces: Delete entries of this name with other keys after writing a new one.

    Returns:
        The path; None if the cache cannot be written.
    """
    entry = folder / f"{name}-{key}{suffix}"
    if entry.exists():
        return entry
    if not _writable(folder):
        return None
    with replacing(entry) if suffix else replacing_folder(entry) as temporary:
        write(temporary)
    if replaces:
        for other in folder.glob(f"{name}-{'?' * len(key)}{suffix}"):
            if other != entry:
                other.unlink() if suffix else shutil.rmtree(other, ignore_errors=True)
    return entry


def cached_arrays(
    capture: Capture, name: str, parameters: Mapping[str, Any], compute: Callable[[], Arrays]
) -> Arrays:
    """Arrays computed from the frames, depth and poses of a capture.

    They are cached for captures whose images are memory-mapped, beside these images. For short
    captures they are computed each time.

    Args:
        capture: With frames.
        name: Of what is computed.
        parameters: What else the arrays depend on, as JSON.
        compute: Computes the arrays.
    """
    frames, depth = capture.needed_frames, capture.depth
    stacks = [frames.images] if depth is None else [frames.images, depth.stored]
    files = [Path(one.filename) for one in stacks if isinstance(one, np.memmap) and one.filename]
    if len(files) < len(stacks):
        return compute()
    lens = [asdict(capture.camera), capture.near, capture.far, frames.encoding]
    lens += [] if depth is None else [asdict(depth.camera), depth.unit]
    key = cache_key(
        files,
        dict(parameters),
        lens,
        capture.frame_pose(np.arange(len(frames))).detach().double().numpy(),
        capture.split.train,
        np.zeros(0) if capture.points is None else capture.points,
    )
    computed: list[Arrays] = []

    def write(path: Path) -> None:
        computed.append(compute())
        write_arrays(path, computed[0])

    while (entry := cached(files[0].parent, name, key, write, suffix=".npz")) is not None:
        if computed:
            return computed[0]
        try:
            return load_arrays(entry)
        except CaptureError:  # damaged: compute it again
            entry.unlink()
    return compute()


def _writable(folder: Path) -> bool:
    """Whether entries can be written to a folder, which may not exist yet."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    return os.access(existing, os.W_OK)
