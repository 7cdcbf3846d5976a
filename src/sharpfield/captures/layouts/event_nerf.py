"""EventNeRF's data: one colour event camera that circles a scene once.

    train/pose/*.txt          camera-to-world, 16 numbers, OpenCV axes; pose i of n at i / (n - 1)
    train/intrinsics/*.txt    16 numbers (a 4x4 matrix), or 20: a fifth row begins with k1, k2
    train/events/NAME.npz     x, y, t, p; the files do not state the unit of t
    train/rgb/*.png           an image for each pose, optional
    test/, validation/        pose, intrinsics and rgb of other views, optional

Time runs from 0 to the last event. Its unit must be given: the authors only use t relative to its
maximum. Poses are interpolated linearly. The sensor has an RGGB filter.

Source: Rudnev et al., *EventNeRF* (CVPR 2023), and its data loader; NeRF++ for the layout.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import estimated_bounds
from sharpfield.captures.layouts._rgbd import read_matrix
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry.trajectory import Stamped, Tracks, check_poses
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.images import list_images, read_images

SENSOR = (346, 260)
"""Sensor resolution of the authors, real and simulated: width and height in pixels."""
TILE = "RGGB"


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    train = folder / "train"
    return (train / "pose").is_dir() and any((train / "events").glob("*.npz"))


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read the events, the poses, and the images if there are any.

    Args:
        folder: Holds what the module describes.
        options: `event_unit` is required.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent, or the unit is not given.
    """
    train = folder / "train"
    files = sorted((train / "events").glob("*.npz"))
    if len(files) != 1:
        raise CaptureError(
            "there must be one file of events",
            where=train / "events",
            got=", ".join(file.name for file in files) or "none",
            do="read each recording as a capture of its own",
        )
    poses, camera = _poses(train), _camera(train)
    with open_events(files[0], unit=options.event_unit, size=SENSOR) as file:
        if file.unit is None:
            raise CaptureError(
                "EventNeRF's files do not state the unit of their event times",
                where=files[0],
                do="give it with --event-unit (`event_unit`): ns, us, ms or s",
            )
        events = read_events(replace(file, bayer=TILE))
    if not len(events) or len(poses) < 2:
        raise CaptureError(
            "there must be events, and at least two poses",
            where=train,
            got=f"{len(events)} events, {len(poses)} poses",
            do="complete the download",
        )
    clock = Clock(0, int(events.t_us[-1]))
    times_us = np.rint(np.linspace(0, clock.span_us, len(poses))).astype(np.int64)
    path = Stamped(times_us, poses, clock, "linear")
    others = [folder / name for name in ("test", "validation")]
    held_out = next((other for other in others if _images(other)), None)
    still = np.zeros((0, 3, 4)) if held_out is None else _poses(held_out)
    frames, split = _frames(train, held_out, times_us, len(still))
    near, far = estimated_bounds(poses)
    return Capture(
        camera=camera,
        trajectory=Tracks([path], still) if len(still) else path,
        clock=clock,
        near=near,
        far=far,
        frames=frames,
        events=events,
        split=split,
        name=folder.resolve().name,
        source="event-nerf",
        known=Known(bounds="estimated"),
    )


def _images(folder: Path) -> list[Path]:
    """The images of a set, if there are any."""
    return list_images(folder / "rgb") if (folder / "rgb").is_dir() else []


def _frames(
    train: Path, held_out: Path | None, times_us: Int64[np.ndarray, "p"], others: int
) -> tuple[Frames | None, Split]:
    """Images on the moving track, and held-out ones on tracks of their own."""
    moving, still = _images(train), [] if held_out is None else _images(held_out)
    for name, found, poses in (("train", moving, len(times_us)), ("held-out", still, others)):
        if found and len(found) != poses:
            raise CaptureError(
                f"there must be a pose for each {name} image",
                where=found[0].parent,
                got=f"{len(found)} images, {poses} poses",
                do="complete the download",
            )
    if not moving and not still:
        return None, Split(np.zeros(0, np.int64), np.zeros(0, np.int64))
    t_us = np.concatenate([times_us[: len(moving)], np.zeros(len(still), np.int64)])
    frames = Frames(
        images=read_images([*moving, *still]),
        exposure=Exposure(t_us, t_us),
        track=np.concatenate([np.zeros(len(moving), np.int64), 1 + np.arange(len(still))]),
        names=tuple(f"{path.parent.parent.name}/{path.stem}" for path in [*moving, *still]),
        encoding="srgb",
    )
    every = np.arange(len(frames))
    return frames, Split(every[: len(moving)], every[len(moving) :])


def _camera(train: Path) -> Camera:
    """The camera, which all poses share."""
    files = sorted((train / "intrinsics").glob("*.txt"))
    if not files:
        raise CaptureError(
            "there are no intrinsics", where=train / "intrinsics", do="add NAME.txt of 16 numbers"
        )
    numbers = _numbers(files[0], (16, 20))
    matrix, radial = numbers[:16].reshape(4, 4), numbers[16:18]
    lens, distortion = "pinhole", ()
    if radial.any():
        lens, distortion = "brown", (float(radial[0]), float(radial[1]), 0.0, 0.0, 0.0)
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(*SENSOR, fx, fy, cx, cy, lens, distortion)


def _poses(folder: Path) -> Float64[np.ndarray, "p 3 4"]:
    files = sorted((folder / "pose").glob("*.txt"))
    if not files:
        raise CaptureError(
            "there are no poses", where=folder / "pose", do="add NAME.txt of 16 numbers"
        )
    poses = np.stack([_numbers(file, (16,)).reshape(4, 4)[:3] for file in files])
    check_poses(poses, folder / "pose")
    return poses


def _numbers(path: Path, counts: tuple[int, ...]) -> Shaped[np.ndarray, "n"]:
    """The numbers of a text file, whose count must be one of `counts`."""
    numbers = read_matrix(path).ravel()
    if len(numbers) not in counts:
        raise CaptureError(
            f"there must be {' or '.join(map(str, counts))} numbers",
            where=path,
            got=len(numbers),
            do="write a matrix of 4x4, row by row",
        )
    return numbers


LAYOUT = Layout(
    "event-nerf",
    recognise,
    read,
    "train/pose/, train/intrinsics/ and train/events/*.npz",
    options=("event_unit",),
)
