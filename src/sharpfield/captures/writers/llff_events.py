"""Write a capture in the layout of Ev-DeblurNeRF's data, see `layouts.llff_events`.

A mono event camera gives the Blender variant (times in ns), a colour one the Color-DAVIS variant
(times in us, `ev_map.npz`). The layout cannot store lens distortion, a principal point off the
centre, images other than 8-bit RGB, events of several cameras, or another choice of held-out
frames; a capture with these is refused. Sparse points and notes are left out, and images are
renumbered.
"""

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Float64, Int64, Shaped

from sharpfield.captures.layouts.llff_events import BLENDER, COLOR_DAVIS, RGGB, Variant, recognise
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.core.frames import Frames
from sharpfield.geometry.trajectory import Stamped, Tracks
from sharpfield.storage.arrays import expect_replaceable
from sharpfield.storage.event_file import CHUNK
from sharpfield.storage.event_layouts import THRESHOLDS
from sharpfield.storage.images import write_image

STAMP_US = 5_000
"""Distance of the stamps where the trajectory is not stamped itself."""

ROWS = 65_536
"""Events in an HDF5 chunk."""


@dataclass(frozen=True)
class Stamps:
    """A trajectory as the layout stores it."""

    times_us: Int64[np.ndarray, "p"]
    poses: Float64[np.ndarray, "p 3 4"]


def write(capture: Capture, folder: Path | str) -> None:
    """Write frames, events and trajectory; the folder appears whole or not at all.

    Raises:
        CaptureError: The folder holds something that is not a capture, or the layout cannot store
            something essential.
    """
    folder = Path(folder)
    expect_replaceable(folder, recognise)
    frames, events = capture.needed_frames, capture.needed_events
    variant = COLOR_DAVIS if events.coloured else BLENDER
    _expect_expressible(capture, variant)
    stamps = _stamps(capture)
    with replacing_folder(folder) as fresh:
        _write_images(frames, fresh)
        _write_poses(fresh / "poses_bounds.npy", _frame_poses(capture), capture)
        _write_poses(fresh / "all_poses_bounds.npy", stamps.poses, capture)
        np.save(fresh / "all_timestamps.npy", stamps.times_us)
        if variant is COLOR_DAVIS:
            map_x, map_y = _rectified_sites(events, capture.camera)
            np.savez(fresh / "ev_map.npz", inv_mapx=map_x, inv_mapy=map_y)
        _write_events(fresh / "events.h5", capture, variant)


def _write_images(frames: Frames, folder: Path) -> None:
    digits = max(2, len(str(len(frames) - 1)))
    names = [f"{i:0{digits}d}" for i in range(len(frames))]
    for name, image in zip(names, frames.images, strict=True):
        write_image(folder / "images_1" / f"{name}.png", image)
    times = frames.exposure
    np.savez(
        folder / "images_1" / "timestamps.npz",
        timestamps=times.middle_us,
        timestamps_start=times.open_us,
        timestamps_end=times.close_us,
        start=times.open_us.min(),
        end=times.close_us.max(),
    )
    if frames.truth is not None:
        truth = {names[i]: frames.truth[i] for i in np.flatnonzero(frames.with_truth)}
        np.savez_compressed(folder / "truth.npz", **truth)


def _write_poses(path: Path, poses: Float64[np.ndarray, "n 3 4"], capture: Capture) -> None:
    camera = capture.camera
    right, down, forward, centre = np.moveaxis(poses, -1, 0)
    size = np.broadcast_to(np.array([camera.height, camera.width, camera.fx_px]), centre.shape)
    matrix = np.stack([down, right, -forward, centre, size], -1).reshape(len(poses), 15)
    bounds = np.broadcast_to(np.array([capture.near, capture.far]), (len(poses), 2))
    np.save(path, np.concatenate([matrix, bounds], 1))


def _write_events(path: Path, capture: Capture, variant: Variant) -> None:
    events = capture.needed_events
    ticks = 1000 if variant.event_unit == "ns" else 1
    kinds = {"x": events.x.dtype, "y": events.y.dtype, "t": np.int64, "p": np.uint8}
    if variant is COLOR_DAVIS:
        kinds |= {"x": np.dtype(np.float32), "y": np.dtype(np.float32)}
    with h5py.File(path, "w") as file:
        file.attrs["tick_ns"] = 1000 // ticks
        if (known := capture.known.thresholds) is not None:
            file.attrs.update(zip(THRESHOLDS, (known.negative, known.positive), strict=True))
        rows = min(ROWS, max(len(events), 1))
        packing = {"chunks": (rows,), "compression": "gzip", "shuffle": True}
        columns = {
            name: file.create_dataset(name, (len(events),), kind, **packing)
            for name, kind in kinds.items()
        }
        for first in range(0, len(events), CHUNK):
            part = slice(first, min(first + CHUNK, len(events)))
            chunk = events[part]
            columns["x"][part], columns["y"][part] = chunk.x, chunk.y
            columns["t"][part], columns["p"][part] = chunk.t_us * ticks, chunk.p > 0


def _stamps(capture: Capture) -> Stamps:
    """The stamps of the moving track, or samples of it."""
    path = capture.trajectory
    if isinstance(path, Tracks) and len(path.moving):
        path = path.moving[0]
    if isinstance(path, Stamped) and path.translation == "cubic":
        return Stamps(path.times_us, path.poses)
    known = capture.trajectory.known_us(0)
    if known is None:
        raise CaptureError(
            "this layout needs a moving camera, whose poses are known over time",
            where=capture.name,
            got="a static camera",
            do="write our own layout instead",
        )
    count = -(-(known[1] - known[0]) // STAMP_US)
    times_us = np.minimum(known[0] + np.arange(count + 1) * STAMP_US, known[1]).astype(np.int64)
    return Stamps(times_us, _poses(capture, times_us, np.zeros(count + 1, np.int64)))


def _frame_poses(capture: Capture) -> Float64[np.ndarray, "n 3 4"]:
    frames = capture.needed_frames
    poses = _poses(capture, frames.exposure.middle_us, frames.track)
    if isinstance(capture.trajectory, Tracks):  # its still poses come back as float32 otherwise
        moving = len(capture.trajectory.moving)
        still = frames.track >= moving
        poses[still] = capture.trajectory.still.poses[frames.track[still] - moving]
    return poses


def _poses(
    capture: Capture, times_us: Int64[np.ndarray, "n"], track: Int64[np.ndarray, "n"]
) -> Float64[np.ndarray, "n 3 4"]:
    time = torch.from_numpy(capture.clock.unit(times_us))
    return capture.trajectory.pose(time, torch.from_numpy(track)).double().numpy()


def _rectified_sites(
    events: EventStream, camera: Camera
) -> tuple[Shaped[np.ndarray, "h w"], Shaped[np.ndarray, "h w"]]:
    """Where each pixel of the raw sensor reports; itself, if coordinates were not rectified."""
    shape = (camera.height, camera.width)
    colour = events.site_colour
    if colour is None:
        if events.bayer != "RGGB":
            raise _not_expressible("another colour filter tile than RGGB", events.bayer)
        row, column = np.indices(shape).astype(np.float32)
        return column, row
    tiled = np.tile(RGGB, (camera.height // 2 + 1, camera.width // 2 + 1))
    tiled = tiled[: camera.height, : camera.width].ravel()
    if colour.channel.shape != tiled.shape or (colour.channel != tiled).any():
        raise _not_expressible(
            "rectified positions other than those of an RGGB sensor, row by row",
            f"{len(colour.channel)} positions, {camera.width}x{camera.height} pixels",
        )
    return colour.x.reshape(shape), colour.y.reshape(shape)


def _expect_expressible(capture: Capture, variant: Variant) -> None:
    camera, frames = capture.camera, capture.needed_frames
    if capture.needed_events.tracks > 1 or capture.test_events is not None:
        raise _not_expressible("events of several cameras", type(capture.trajectory).__name__)
    centre = (camera.width / 2, camera.height / 2)
    if camera.lens != "pinhole" or camera.fx_px != camera.fy_px:
        raise _not_expressible("lens distortion or oblong pixels", camera)
    if (camera.cx_px, camera.cy_px) != centre:
        raise _not_expressible("a principal point off the centre", camera)
    if frames.images.dtype != np.uint8 or frames.channels != 3:
        kind = f"{frames.images.dtype}, {frames.channels} channels"
        raise _not_expressible("images other than 8-bit RGB", kind)
    if frames.encoding != variant.encoding:
        kind = "colour" if variant is COLOR_DAVIS else "mono"
        raise _not_expressible(
            f"images other than {variant.encoding} beside {kind} events", frames.encoding
        )
    usual = split_by_rule(len(frames), variant.hold_out)
    if not np.array_equal(usual.test, capture.split.test):
        raise _not_expressible(
            f"another choice of held-out frames than {variant.hold_out}",
            f"held out are {', '.join(map(str, capture.split.test))} of {len(frames)}",
        )


def _not_expressible(what: str, got: object) -> CaptureError:
    return CaptureError(
        f"the layout of Ev-DeblurNeRF cannot store {what}",
        got=got,
        do="write our own layout instead",
    )
