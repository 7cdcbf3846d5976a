"""Blur a folder of sharp pictures, each by one random motion kernel, and say what was done."""

import json
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing_folder
from sharpfield.core.seed import numpy_generator
from sharpfield.simulation.motion_kernel import PUBLISHED, KernelRange, blurred, drawn_blur
from sharpfield.storage.images import list_images, read_image, write_image

ABOUT = "blur.json"


def blur_pictures(
    folder: Path, out: Path, *, ranges: KernelRange = PUBLISHED, seed: int = 0
) -> list[dict[str, Any]]:
    """Write blurred copies of the same names and sizes, and `blur.json`; all of it or nothing.

    Pictures that stay sharp are copied byte for byte. What is drawn for a picture depends on the
    seed and its place in the order of names.

    Args:
        folder: PNG or JPEG pictures.
        out: A new or empty folder, or an earlier result.
        ranges: What kernels are drawn from.
        seed: Another seed, other kernels.

    Returns:
        A row for each picture: its name, whether it was blurred, k, phi, and how far it reaches.

    Raises:
        CaptureError: There are no pictures, one cannot be read, or `out` holds something else.
    """
    paths = list_images(folder)
    if not paths:
        raise CaptureError("there are no pictures", where=folder, do="give PNG or JPEG files")
    if out.exists() and not (out.is_dir() and (is_result(out) or not any(out.iterdir()))):
        raise CaptureError(
            "will not replace what is not a folder of blurred pictures",
            where=out,
            do="choose another place, or empty it",
        )
    rows: list[dict[str, Any]] = []
    with replacing_folder(out) as fresh:
        for i, path in enumerate(paths):
            drawn = drawn_blur(ranges, numpy_generator(seed, i, "kernel"))
            if drawn is None:
                (fresh / path.name).write_bytes(path.read_bytes())
                rows.append({"name": path.name, "blurred": False})
                continue
            write_image(fresh / path.name, blurred(read_image(path), drawn.kernel))
            about = {"k": drawn.k, "phi": drawn.phi, "length_px": drawn.length_px}
            rows.append({"name": path.name, "blurred": True, **about})
        written = {
            "seed": seed,
            "k": list(ranges.k),
            "phi": list(ranges.phi),
            "probability": ranges.probability,
            "pictures": rows,
        }
        (fresh / ABOUT).write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
    return rows


def is_result(folder: Path) -> bool:
    """Whether a folder was written by `blur_pictures`."""
    return (folder / ABOUT).is_file()
