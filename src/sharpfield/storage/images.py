"""Reading and writing still images, exactly as stored.

Many images of one size are one array. Where they come from files and are large together, they are
decoded once, in parallel, into the disk cache and memory-mapped from there: a training step needs a
few frames of thousands, and decoding them again each time would cost more than the step.

Values come back as the file holds them: 8 or 16 bit, RGB or grey, no PNG gamma applied, not turned
by EXIF (poses and intrinsics refer to the stored orientation). How values relate to
light is stated by `Frames.encoding`.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8, UInt16

from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing
from sharpfield.storage.disk_cache import cache_folder, cache_key, cached

SUFFIXES = (".png", ".jpg", ".jpeg")

Alpha = Literal["drop", "white"]
"""What to do with an alpha channel: drop it, or composite the image on white."""

Image = UInt8[np.ndarray, "h w c"] | UInt16[np.ndarray, "h w c"]
Images = UInt8[np.ndarray, "n h w c"] | UInt16[np.ndarray, "n h w c"]
Pixels = Shaped[np.ndarray, "..."]
Stack = Shaped[np.ndarray, "n ..."]
Item = TypeVar("Item")

IN_MEMORY = 256_000_000
"""Up to this number of bytes images are held in memory, larger stacks are memory-mapped."""


def list_images(folder: Path) -> list[Path]:
    """Images in a folder, sorted by name; files whose name starts with a dot are left out."""
    if not folder.is_dir():
        raise CaptureError("image folder not found", where=folder, do="check the path")
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    )


def read_image(path: Path, *, alpha: Alpha = "drop") -> Image:
    """One image, `[h w c]` with c = 3 (RGB) or 1 (grey), uint8 or uint16.

    Args:
        path: A PNG or JPEG file.
        alpha: `white` composites an RGBA image on white, in stored values.

    Raises:
        CaptureError: The file is missing, truncated, not an image, or neither 8 nor 16 bit.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise CaptureError("image not found", where=path, do="check the path") from None
    if not _ends_well(data):
        raise CaptureError(
            "image file is truncated", where=path, got=f"{len(data)} bytes", do="copy it again"
        )
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise CaptureError("cannot decode image", where=path, do="use PNG or JPEG")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise CaptureError(
            "images must have 8 or 16 bits", where=path, got=pixels.dtype, do="convert them"
        )
    if pixels.ndim == 2:
        return pixels[..., None]
    rgb = np.ascontiguousarray(pixels[..., 2::-1])
    if pixels.shape[-1] == 4 and alpha == "white":
        return _on_white(rgb, pixels[..., 3:])
    return rgb


def read_images(paths: Sequence[Path], *, alpha: Alpha = "drop") -> Images:
    """Images of one size and type, decoded in parallel and held in memory.

    Raises:
        CaptureError: There are none, one cannot be read, or they differ in size or type.
    """
    return image_stack(paths, lambda path: read_image(path, alpha=alpha))


def image_stack(
    items: Sequence[Item],
    decode: Callable[[Item], Pixels],
    *,
    sources: Sequence[Path] = (),
    kind: str = "",
    in_memory: int = IN_MEMORY,
) -> Stack:
    """Images of one size and type as one array; memory-mapped, read only, if they are large.

    Args:
        items: What identifies each image to `decode`, such as its path.
        decode: Returns the pixels of an image.
        sources: Files that the images come from, whose cache they go to; without files all images
            are held in memory.
        kind: What the images are and how they were decoded, e.g. "colour 640x480": part of the key.
        in_memory: Maximum number of bytes that are held in memory.

    Raises:
        CaptureError: There are none, one cannot be read, or they differ in shape or type.
    """
    if not items:
        raise CaptureError("there are no images to read", do="add PNG or JPEG files")
    first = decode(items[0])
    shape = (len(items), *first.shape)
    if sources and first.nbytes * len(items) > in_memory:

        def write(path: Path) -> None:
            images = np.lib.format.open_memmap(path, "w+", first.dtype, shape)
            _fill(images, items, decode, first)
            images.flush()

        key = cache_key(sources, kind, len(items))
        entry = cached(cache_folder(sources[0].parent), "images", key, write, suffix=".npy")
        if entry is not None:
            return np.load(entry, mmap_mode="r")
    images = np.empty(shape, first.dtype)
    _fill(images, items, decode, first)
    return images


def _fill(
    images: Stack, items: Sequence[Item], decode: Callable[[Item], Pixels], first: Pixels
) -> None:
    def decode_into(i: int) -> None:
        image = decode(items[i]) if i else first
        if image.shape != first.shape or image.dtype != first.dtype:
            raise CaptureError(
                "images differ in size or type",
                where=f"{items[0]} and {items[i]}",
                got=f"{describe(first)} and {describe(image)}",
                do="a capture has one camera: bring all images to one size, bit depth and colour",
            )
        images[i] = image

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        for _ in pool.map(decode_into, range(len(items))):
            pass


def write_image(path: Path, image: Image) -> None:
    """Write `[h w c]` (grey, RGB or RGBA; uint8 or uint16) as the format its suffix names.

    The file appears whole or not at all.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise CaptureError("unknown image suffix", where=path, do=f"use one of {SUFFIXES}")
    swapped = image[..., [2, 1, 0, 3][: image.shape[-1]]] if image.shape[-1] > 2 else image
    _, data = cv2.imencode(path.suffix, np.ascontiguousarray(swapped))
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())


def describe(image: Pixels) -> str:
    """Size and type in words, e.g. `600x400 RGB 8 bit`."""
    height, width, channels = image.shape if image.ndim == 3 else (*image.shape, 1)
    colour = {1: "grey", 3: "RGB", 4: "RGBA"}.get(channels, f"{channels} channels")
    return f"{width}x{height} {colour} {8 * image.dtype.itemsize} bit"


def _on_white(
    rgb: Shaped[np.ndarray, "h w 3"], alpha: Shaped[np.ndarray, "h w 1"]
) -> Shaped[np.ndarray, "h w 3"]:
    white = np.uint32(np.iinfo(rgb.dtype).max)
    mixed = rgb * alpha.astype(np.uint32) + white * (white - alpha)
    return ((mixed + white // 2) // white).astype(rgb.dtype)


def _ends_well(data: bytes) -> bool:
    """Whether a PNG or JPEG has its end marker; decoders fill missing parts with grey."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-64:]
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    return True
