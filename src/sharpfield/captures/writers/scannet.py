"""Write a capture with depth in ScanNet's exported layout, see `layouts.scannet`.

A capture that the layout cannot store (with events) is refused. The split is not stored: the reader
uses one frame in five for training. Sharp truth and true blur, where known, go to
`exported/truth/`, which other programs ignore. Colour is JPEG, as published, and so not exact.
"""

from pathlib import Path

import numpy as np

from sharpfield.captures.layouts import scannet
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing_folder
from sharpfield.core.frames import MILLIMETRE
from sharpfield.storage.arrays import expect_replaceable
from sharpfield.storage.images import write_image


def write(capture: Capture, folder: Path | str) -> None:
    """Write a capture; the folder appears whole or not at all. An earlier one is replaced.

    Raises:
        CaptureError: The capture has no depth, or has events or lens distortion; or the folder
            holds something else.
    """
    folder = Path(folder)
    depth, frames = capture.needed_depth, capture.needed_frames
    _expect_storable(capture)
    expect_replaceable(folder, scannet.recognise)
    poses = capture.frame_pose(np.arange(len(frames))).detach().double().numpy()
    with replacing_folder(folder) as fresh:
        inner = fresh / "exported"
        for i, image in enumerate(frames.images):
            write_image(inner / scannet.COLOUR[0] / f"{i}.jpg", np.asarray(image))
            steps = np.rint(np.asarray(depth.stored[i]) * (depth.unit / MILLIMETRE))
            stored = steps.clip(0, np.iinfo(np.uint16).max).astype(np.uint16)
            write_image(inner / scannet.DEPTH / f"{i}.png", stored[..., None])
            _write_matrix(inner / scannet.POSE / f"{i}.txt", np.vstack([poses[i], np.eye(4)[3]]))
        _write_matrix(inner / scannet.INTRINSIC_COLOUR, _intrinsics(capture.camera))
        _write_matrix(inner / scannet.INTRINSIC_DEPTH, _intrinsics(depth.camera))
        _write_truth(capture, inner / scannet.TRUTH)


def _write_truth(capture: Capture, folder: Path) -> None:
    frames = capture.needed_frames
    if frames.truth is not None:
        for i in np.flatnonzero(frames.with_truth):
            write_image(folder / f"{i}.png", np.asarray(frames.truth[i]))
    if frames.blur_px is not None:
        _write_matrix(folder / scannet.BLUR, frames.blur_px[:, None])


def _expect_storable(capture: Capture) -> None:
    frames = capture.needed_frames
    problems = {
        "events": capture.events is not None,
        "images of 16 bits": frames.images.dtype != np.uint8,
        "grey images": frames.channels != 3,
        "a lens that distorts": capture.camera.lens != "pinhole",
    }
    if found := [what for what, wrong in problems.items() if wrong]:
        raise CaptureError(
            f"the layout scannet cannot store {' or '.join(found)}",
            where=capture.name,
            do="write the native layout",
        )


def _intrinsics(camera: Camera) -> np.ndarray:
    matrix = np.eye(4)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
    return matrix


def _write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix, fmt="%.9g")
