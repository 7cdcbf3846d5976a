"""Frames and measured depth in our own layout.

Frames have a table each in `[frames] each`, and PNG files in `frames/` and `truth/`. A table gives
`name`, `open_us` and `close_us`; `track` (0), `use` ("train", "test", "both" or "none"; "train"),
`file` (NAME.png) and `truth` (whether `truth/` has the sharp image) have the defaults in brackets;
`blur_px` is the true length of the motion blur, where known. `truth/depth.npy` and `truth/flow.npy`
are of all frames, where known. `[frames] row_delay_us` (0) is that of a rolling shutter.

Measured depth has the table `[depth]` with its unit and camera, and PNG files in `depth/` with the
names of the frames' files: 16 bit, grey, 0 where nothing was measured.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Shaped, UInt16

from sharpfield.captures.native.trajectory import camera_table, read_camera
from sharpfield.core.capture import Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import DepthMaps, Exposure, Frames
from sharpfield.storage.arrays import load_array
from sharpfield.storage.images import describe, image_stack, read_image, write_image
from sharpfield.storage.toml_tables import Table

DEPTH = "depth"


def write_depth(depth: DepthMaps, files: Sequence[str], folder: Path) -> dict[str, Any]:
    """Write depth maps under the names of the frames' files, and return their table."""
    for file, stored in zip(files, depth.stored, strict=True):
        write_image(folder / DEPTH / file, np.asarray(stored)[..., None])
    return {"unit": depth.unit, "camera": camera_table(depth.camera)}


def read_depth(about: Table, files: Sequence[str], folder: Path) -> DepthMaps:
    """Read the depth maps that `write_depth` wrote.

    Raises:
        CaptureError: A map is missing or malformed.
    """
    about.expect_only("unit", "camera")
    paths = [folder / DEPTH / file for file in files]
    return DepthMaps(
        image_stack(paths, decode_depth, sources=paths, kind="depth"),
        read_camera(about.table("camera")),
        about.number("unit"),
    )


def decode_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """Read a depth map as stored.

    Raises:
        CaptureError: The file is missing, or is not a grey image of 16 bit.
    """
    image = read_image(path)
    if image.dtype != np.uint16 or image.shape[-1] != 1:
        raise CaptureError(
            "a depth map must be a grey image of 16 bit",
            where=path,
            got=describe(image),
            do="write 16-bit PNG files",
        )
    return image[..., 0]


FRAMES, TRUTH = "frames", "truth"
GEOMETRY = {"depth": (), "flow": (2,)}
"""Fields of `Frames` with an entry per pixel, and their trailing shape."""

USES = {(True, False): "train", (False, True): "test", (True, True): "both", (False, False): "none"}
"""Values of `use`, by whether a frame is for training and whether it is held out."""

PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
KEYS = ("name", "open_us", "close_us", "track", "use", "file", "truth", "blur_px")


def write_frames(frames: Frames, split: Split, folder: Path) -> list[dict[str, Any]]:
    """Write the images, and return the table of each frame.

    Raises:
        CaptureError: Sharp images differ in size or type from the frames, or the split is not in
            ascending order.
    """
    _expect_same_kind(frames)
    for part in (split.train, split.test):
        if (np.diff(part) <= 0).any():
            raise CaptureError(
                "a split must list frames in ascending order, each once", got=part, do="sort it"
            )
    index = np.arange(len(frames))
    train, held_out = np.isin(index, split.train), np.isin(index, split.test)
    files = files_of(frames.names)
    tables = []
    for i, file in enumerate(files):
        write_image(folder / FRAMES / file, frames.images[i])
        table: dict[str, Any] = {
            "name": frames.names[i],
            "open_us": int(frames.exposure.open_us[i]),
            "close_us": int(frames.exposure.close_us[i]),
        }
        if frames.track[i]:
            table["track"] = int(frames.track[i])
        if (use := USES[bool(train[i]), bool(held_out[i])]) != "train":
            table["use"] = use
        if file != f"{frames.names[i]}.png":
            table["file"] = file
        if frames.truth is not None:
            table["truth"] = bool(frames.with_truth[i])
            if table["truth"]:
                write_image(folder / TRUTH / file, frames.truth[i])
        if frames.blur_px is not None:
            table["blur_px"] = float(frames.blur_px[i])
        tables.append(table)
    for name in GEOMETRY:
        if (values := getattr(frames, name)) is not None:
            (folder / TRUTH).mkdir(exist_ok=True)
            np.save(folder / TRUTH / f"{name}.npy", values)
    return tables


def read_frames(about: Table, folder: Path) -> tuple[Frames, Split, list[str]]:
    """Read frames, their split, and the names of their files, as `write_frames` wrote them.

    Raises:
        CaptureError: A table or an image is missing or malformed, or images differ in size.
    """
    about.expect_only("encoding", "row_delay_us", "each")
    tables = about.tables("each")
    for table in tables:
        table.expect_only(*KEYS)
    names = tuple(table.text("name") for table in tables)
    files = [_inside(table, folder) for table in tables]
    paths = [folder / FRAMES / file for file in files]
    images = image_stack(paths, read_image, sources=paths, kind="frames")
    truth, known = _read_truth(tables, [folder / TRUTH / file for file in files], images)
    frames = Frames(
        images=images,
        exposure=Exposure(
            *(_column([table.whole(key) for table in tables]) for key in ("open_us", "close_us")),
            row_delay_us=about.number("row_delay_us", 0.0),
        ),
        track=_column([table.whole("track", 0) for table in tables]),
        names=names,
        encoding=about.text("encoding"),
        truth=truth,
        truth_known=known,
        blur_px=_read_blur(tables),
        **_read_geometry(folder / TRUTH, images),
    )
    return frames, _split(tables), files


def _read_blur(tables: Sequence[Table]) -> Float64[np.ndarray, "n"] | None:
    if not any("blur_px" in table.values for table in tables):
        return None
    return np.array([table.number("blur_px") for table in tables])


def _read_truth(
    tables: Sequence[Table], paths: Sequence[Path], images: Shaped[np.ndarray, "n h w c"]
) -> tuple[Shaped[np.ndarray, "n h w c"] | None, Shaped[np.ndarray, "n"] | None]:
    known = np.array([table.yes("truth", False) for table in tables])
    if not known.any():
        return None, None
    existing = [path for path, one in zip(paths, known, strict=True) if one]
    first = read_image(existing[0])
    _expect_like(first[None], images, paths[0].parent)
    unknown = np.zeros_like(first)
    truth = image_stack(
        list(zip(paths, known.tolist(), strict=True)),
        lambda item: read_image(item[0]) if item[1] else unknown,
        sources=existing,
        kind="truth",
    )
    _expect_like(truth, images, paths[0].parent)
    return truth, known


def _expect_like(
    found: Shaped[np.ndarray, "m y x c"], images: Shaped[np.ndarray, "n h w d"], where: Path
) -> None:
    if found.shape[1:] != images.shape[1:] or found.dtype != images.dtype:
        raise CaptureError(
            "sharp images differ from the frames in size or type",
            where=where,
            got=f"{describe(found[0])}, frames {describe(images[0])}",
            do="write sharp images with the size and type of the frames",
        )


def _read_geometry(
    folder: Path, images: Shaped[np.ndarray, "n h w c"]
) -> dict[str, Float32[np.ndarray, "..."]]:
    """True depth and optical flow of all frames, as far as their files exist."""
    found = {}
    for name, trailing in GEOMETRY.items():
        path = folder / f"{name}.npy"
        if not path.exists():
            continue
        values = load_array(path)
        expected = (*images.shape[:3], *trailing)
        if values.shape != expected or values.dtype != np.float32:
            raise CaptureError(
                f"{name} differs from the frames in size or type",
                where=path,
                got=f"{values.dtype} {values.shape}, expected float32 {expected}",
                do="write an array of this type and shape",
            )
        found[name] = values
    return found


def _split(tables: Sequence[Table]) -> Split:
    flags_of = {use: flags for flags, use in USES.items()}
    flags = []
    for table in tables:
        use = table.text("use", "train")
        if use not in flags_of:
            raise CaptureError(
                "unknown use of a frame",
                where=table.where,
                got=use,
                do=f"write one of {', '.join(flags_of)}",
            )
        flags.append(flags_of[use])
    train, held_out = np.array(flags).T
    return Split(train=np.flatnonzero(train), test=np.flatnonzero(held_out))


def files_of(names: Sequence[str]) -> list[str]:
    """File names of frames: their own names where every file system allows these, else numbers."""
    unique = len({name.casefold() for name in names}) == len(names)
    if unique and all(PLAIN_NAME.fullmatch(name) for name in names):
        return [f"{name}.png" for name in names]
    return [f"{i:06d}.png" for i in range(len(names))]


def _inside(table: Table, folder: Path) -> str:
    """The file name of a frame, which must lie in the capture's own folder."""
    file = table.text("file", f"{table.text('name')}.png")
    root = (folder / FRAMES).resolve()
    if not (root / file).resolve().is_relative_to(root):
        raise CaptureError(
            "a frame's file lies outside the capture",
            where=table.where,
            got=file,
            do=f"put it into {FRAMES}/",
        )
    return file


def _expect_same_kind(frames: Frames) -> None:
    truth = frames.truth
    if truth is None:
        return
    if truth.shape != frames.images.shape or truth.dtype != frames.images.dtype:
        raise CaptureError(
            "sharp images must have the size and type of the frames",
            got=f"{truth.dtype} {truth.shape}, frames {frames.images.dtype} {frames.images.shape}",
            do="convert the sharp images",
        )


def _column(values: Sequence[int]) -> Shaped[np.ndarray, "n"]:
    return np.array(values, np.int64)
