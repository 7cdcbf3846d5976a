"""Images larger than memory: decoded once beside the capture, memory-mapped ever after.

A step of training looks at a few frames of thousands, and decoding them again each time would cost
more than the step. So the images of a long recording are decoded once, in parallel, into one
`.npy` in the capture's cache folder, and read from there as if they were in memory; the system
keeps of it what is in use. Short recordings are simply loaded. Derived: delete it when you like.
"""

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing
from sharpfield.storage.event_cache import cache_folder

IN_MEMORY = 256_000_000
"""Up to this many bytes of images are loaded, more are mapped."""

Stack = Shaped[np.ndarray, "n ..."]
Pixels = Shaped[np.ndarray, "..."]

Item = TypeVar("Item")


def mapped_images(
    paths: Sequence[Path],
    decode: Callable[[Path], Pixels],
    *,
    kind: str,
    in_memory: int = IN_MEMORY,
) -> Stack:
    """All images of a folder as one array; memory-mapped, read only, if there are many.

    Args:
        paths: Files, at least one, in one folder.
        decode: How to read one; all must come out in one shape and type.
        kind: What they are and how they were decoded, e.g. "colour 640x480": part of the cache's
            name.
        in_memory: How many bytes may be loaded.

    Raises:
        CaptureError: There are none, one cannot be read, or they differ in shape or type.
    """
    return mapped(paths, decode, sources=paths, kind=kind, in_memory=in_memory)


def mapped(
    items: Sequence[Item],
    decode: Callable[[Item], Pixels],
    *,
    sources: Sequence[Path],
    kind: str,
    in_memory: int = IN_MEMORY,
) -> Stack:
    """The same for images that have no files of their own.

    Args:
        items: What names an image to `decode`.
        decode: Gives its pixels.
        sources: Files that the images come from; the cache lies where they do.
        kind: See `mapped_images`.
        in_memory: How many bytes may be loaded.
    """
    if not items:
        raise CaptureError("there are no images to read")
    first = decode(items[0])
    shape = (len(items), *first.shape)
    if first.nbytes * len(items) <= in_memory:
        images = np.empty(shape, first.dtype)
        _fill(images, items, decode, first)
        return images
    named = f"{kind}/{len(items)}"
    place = cache_folder(sources[0].parent) / f"images-{_key(sources, named)}.npy"
    if not place.exists():
        with replacing(place) as temporary:
            images = np.lib.format.open_memmap(temporary, "w+", first.dtype, shape)
            _fill(images, items, decode, first)
            images.flush()
    return np.load(place, mmap_mode="r")


def _fill(
    images: Stack, items: Sequence[Item], decode: Callable[[Item], Pixels], first: Pixels
) -> None:
    def place(i: int) -> None:
        image = decode(items[i]) if i else first
        if image.shape != first.shape or image.dtype != first.dtype:
            raise CaptureError(
                "images differ in size or type",
                where=f"{items[0]} and {items[i]}",
                got=f"{first.shape} {first.dtype} and {image.shape} {image.dtype}",
                do="a capture has one camera: bring all images to one size, bit depth and colour",
            )
        images[i] = image

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        for _ in pool.map(place, range(len(items))):
            pass


def _key(paths: Sequence[Path], kind: str) -> str:
    """Changes when a file is added, removed or written again."""
    digest = hashlib.blake2b(kind.encode(), digest_size=10)
    for path in paths:
        about = path.stat()
        digest.update(f"{path.name}/{about.st_size}/{about.st_mtime_ns}\n".encode())
    return digest.hexdigest()
