"""Photos with a COLMAP reconstruction.

    images/ or images_N/    photos; images_N are N times smaller
    sparse/0/               cameras, images and points3D, .bin or .txt;
                            or in sparse/ or colmap/sparse/0/

Intrinsics are scaled to the size of the images that are read. Depth bounds come from the points.
"""

from pathlib import Path

from sharpfield.captures.hold_out import split_by_rule
from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import (
    HOLD_OUT,
    Photos,
    choose_images,
    depth_bounds,
    existing,
    photo_capture,
    same_camera,
)
from sharpfield.captures.layouts.colmap_model import Model, find_model, read_model
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import SUFFIXES, read_images


def recognise(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model and images, and no pose table of another layout."""
    return (
        find_model(folder) is not None
        and any(folder.glob("images*/"))
        and not (folder / "poses_bounds.npy").exists()
        and not (folder / "transforms.json").exists()
    )


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read photos and their reconstruction.

    Args:
        folder: Holds what the module describes.
        options: `factor` of the images, by default the smallest there are; `hold_out`; `bounds`,
            by default what the points show; `missing` photos of the model.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    model_folder = find_model(folder)
    if model_folder is None:
        raise CaptureError("no COLMAP model", where=folder, do="put one in sparse/0")
    model = read_model(model_folder)
    paths = _image_paths(choose_images(folder, options.factor), model)
    kept = existing(paths, missing=options.missing, where=model_folder)
    names = [model.names[i] for i in kept]
    photos = Photos(
        images=read_images([paths[i] for i in kept]),
        poses=model.poses[kept],
        names=[Path(name).with_suffix("").as_posix() for name in names],
        camera=same_camera([model.cameras[i] for i in kept], names, where=model_folder),
    )
    return photo_capture(
        photos,
        split_by_rule(len(kept), options.hold_out or HOLD_OUT),
        bounds=options.bounds
        or depth_bounds(model.points, model.poses, model.seen, where=model_folder),
        name=folder.resolve().name,
        source="colmap",
        points=model.points if len(model.points) else None,
    )


def _image_paths(folder: Path, model: Model) -> list[Path]:
    """The path of each photo; downscaled copies may have another suffix than the model states."""
    return [_with_any_suffix(folder / name) for name in model.names]


def _with_any_suffix(path: Path) -> Path:
    candidates = [
        path,
        *(path.with_suffix(s) for suffix in SUFFIXES for s in (suffix, suffix.upper())),
    ]
    return next((candidate for candidate in candidates if candidate.is_file()), path)


LAYOUT = Layout(
    "colmap",
    recognise,
    read,
    "sparse/0/cameras.bin and images*/",
    options=("factor", "missing"),
)
