"""Measured depth in our own layout: `[depth]` with its unit and camera, and PNG files in `depth/`.

The files have the names of the frames' own, 16 bit, grey, 0 where nothing was measured.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16

from sharpfield.captures.mapped_images import mapped_images
from sharpfield.captures.native_camera import camera_table, read_camera
from sharpfield.captures.toml_tables import Table
from sharpfield.core.depth import DepthMaps
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import describe, read_image, write_image

DEPTH = "depth"


def write_depth(depth: DepthMaps, files: Sequence[str], folder: Path) -> dict[str, Any]:
    """Write the maps under the names of the frames' files, and return what describes them."""
    for file, stored in zip(files, depth.stored, strict=True):
        write_image(folder / DEPTH / file, np.asarray(stored)[..., None])
    return {"unit": depth.unit, "camera": camera_table(depth.camera)}


def read_depth(about: Table, files: Sequence[str], folder: Path) -> DepthMaps:
    """Read what `write_depth` wrote.

    Raises:
        CaptureError: A map is missing or malformed.
    """
    about.expect_only("unit", "camera")
    paths = [folder / DEPTH / file for file in files]
    return DepthMaps(
        mapped_images(paths, decode_depth, kind="depth"),
        read_camera(about.table("camera")),
        about.number("unit"),
    )


def decode_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """A depth map as stored.

    Raises:
        CaptureError: The file is missing, or not a grey image of 16 bit.
    """
    image = read_image(path)
    if image.dtype != np.uint16 or image.shape[-1] != 1:
        raise CaptureError(
            "a depth map must be a grey image of 16 bit", where=path, got=describe(image)
        )
    return image[..., 0]
