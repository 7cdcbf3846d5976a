"""The layout of Ev-DeblurNeRF's data: blurry and sharp images, events, a stamped trajectory.

    images_1/NN.png             8-bit RGB, sorted by name
    images_1/timestamps.npz     timestamps_start, timestamps_end: us, one per image; equal if sharp
    poses_bounds.npy            one row per image, see `layouts.deblur_nerf`
    all_poses_bounds.npy        the trajectory, one row per stamp
    all_timestamps.npy          its stamps, us
    events.h5                   x, y, t, p
    ev_map.npz                  inv_mapx, inv_mapy: Color-DAVIS only
    truth.npz                   optional: sharp mid-exposure images, by name of the blurry one

There are two variants. In Ev-DeblurBlender events have whole coordinates and times in ns. In
Ev-DeblurCDAVIS a colour event camera's coordinates were rectified: the pixel in row j and column i
of the raw sensor (RGGB) reports at (inv_mapx[j, i], inv_mapy[j, i]), exactly.

Source: Cannici and Scaramuzza, *Mitigating Motion Blur in Neural Radiance Fields with Events and
Frames* (CVPR 2024), its supplement and released data.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Int64, Shaped

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._photos import choose_images
from sharpfield.captures.layouts.deblur_nerf import PosesBounds, read_poses_bounds
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.camera import Camera
from sharpfield.core.capture import POSE_TOLERANCE_US, Capture, Clock, Known, Note, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped, Tracks
from sharpfield.storage.arrays import load_array, load_arrays
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_columns import whole_us
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.images import list_images, read_images

TRAJECTORY = ("all_poses_bounds.npy", "all_timestamps.npy")

OFF_TRAJECTORY_PX = 1.0
"""A frame is off the trajectory if its own pose, compared with the trajectory at its time, would
move the nearest points by more than this in the image."""

RGGB = np.array([[0, 1], [1, 2]], np.int8)
"""Channels of the Bayer tile of a Color-DAVIS346."""


@dataclass(frozen=True)
class Variant:
    """What the files of one of the two data sets do not state."""

    event_unit: str
    encoding: str
    hold_out: str
    threshold: float
    """Contrast threshold of the authors for both signs, natural log."""
    reference_poses: Literal["frames", "trajectory"]
    """The poses over which the authors normalise the scene."""


BLENDER = Variant("ns", "gamma2.2", "every:8", 0.2, "frames")
COLOR_DAVIS = Variant("us", "linear", "last:5", 0.25, "trajectory")


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout: the files of a trajectory, or a pose table and events."""
    found = [(folder / name).is_file() for name in ("poses_bounds.npy", "events.h5")]
    return all(found) or any((folder / name).is_file() for name in TRAJECTORY)


def variant_of(folder: Path) -> Variant:
    """Color-DAVIS if there is a map of rectified positions, else Blender."""
    return COLOR_DAVIS if (folder / "ev_map.npz").is_file() else BLENDER


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a scene.

    Frames on the trajectory are on track 0. A sharp frame before or after it, and any frame whose
    own pose contradicts it, has a still track of its own.

    Args:
        folder: Holds what the module describes.
        options: `event_unit` where it is not what the data sets have (ns without `ev_map.npz`,
            us with it); `hold_out`.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    variant = variant_of(folder)
    image_folder = choose_images(folder, None)
    paths = list_images(image_folder)
    table = read_poses_bounds(folder / "poses_bounds.npy")
    exposure = _exposure(image_folder / "timestamps.npz")
    _expect_one_each(folder, images=len(paths), poses=len(table), exposures=len(exposure))
    images = read_images(paths)
    scaled = re.fullmatch(r"images_(\d+)", image_folder.name)
    focal = table.focal_px / (float(scaled[1]) if scaled else 1.0)
    height, width = images.shape[1:3]
    # Of the table only the focal length is used, as the authors do.
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    along, path = _trajectory(folder)
    bounds = (along if variant.reference_poses == "trajectory" else table).bounds
    off = _off_trajectory(path, table, exposure, camera, near=float(bounds.min()))
    trajectory, track = _tracks(path, table, off)
    events, thresholds, notes = _events(
        folder, camera, path, event_unit=options.event_unit, variant=variant
    )
    names = tuple(file.stem for file in paths)
    truth, truth_known = _truth(folder / "truth.npz", names, images)
    return Capture(
        camera=camera,
        trajectory=trajectory,
        clock=path.clock,
        near=float(bounds.min()),
        far=float(bounds.max()),
        frames=Frames(images, exposure, track, names, variant.encoding, truth, truth_known),
        events=events,
        split=split_by_rule(len(paths), options.hold_out or variant.hold_out),
        name=folder.resolve().name,
        source="ev-deblur-nerf",
        known=Known(thresholds=thresholds, reference_poses=variant.reference_poses),
        notes=notes
        | ({"frames_off_trajectory": ", ".join(np.array(names)[off])} if off.any() else {}),
    )


def _exposure(path: Path) -> Exposure:
    times = load_arrays(path)
    columns = []
    for name in ("timestamps_start", "timestamps_end"):
        if name not in times:
            raise CaptureError(
                f"array {name} is missing",
                where=path,
                got=", ".join(times) or "no arrays",
                do="store the start and end of each exposure, in us",
            )
        columns.append(whole_us(times[name], "us", f"{path}, {name}"))
    _expect_one_each(path, starts=len(columns[0]), ends=len(columns[1]))
    return Exposure(*columns)


def _trajectory(folder: Path) -> tuple[PosesBounds, Stamped]:
    poses_file, times_file = (folder / name for name in TRAJECTORY)
    for path in (poses_file, times_file):
        if not path.is_file():
            raise CaptureError(
                "poses over time are missing",
                where=path,
                got="poses of single frames only",
                do="give a pose at least every few ms, over all exposures and events;"
                " one pose per frame does not define the motion in between",
            )
    table = read_poses_bounds(poses_file)
    times_us = whole_us(load_array(times_file), "us", times_file)
    _expect_one_each(f"{poses_file} and {times_file.name}", poses=len(table), times=len(times_us))
    clock = Clock(int(times_us[0]), max(int(times_us[-1] - times_us[0]), 1))
    return table, Stamped(times_us, table.poses, clock)


def _off_trajectory(
    path: Stamped, table: PosesBounds, exposure: Exposure, camera: Camera, *, near: float
) -> Bool[np.ndarray, "n"]:
    """Which frames are off the trajectory."""
    first, last = path.known_us(0)
    begin, end = exposure.open_us + POSE_TOLERANCE_US, exposure.close_us - POSE_TOLERANCE_US
    outside = exposure.instant & ((begin < first) | (end > last))
    time = torch.from_numpy(path.clock.unit(exposure.middle_us))
    expected = path.pose(time, torch.zeros(len(table)).long())
    twist = se3.log(se3.compose(se3.inverse(expected), torch.from_numpy(table.poses))).numpy()
    angle, distance = np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)
    return outside | (camera.fx_px * (angle + distance / near) > OFF_TRAJECTORY_PX)


def _tracks(
    path: Stamped, table: PosesBounds, off: Bool[np.ndarray, "n"]
) -> tuple[Trajectory, Int64[np.ndarray, "n"]]:
    """The trajectory with a still track for each frame off it, and the track of each frame."""
    if not off.any():
        return path, np.zeros(len(off), np.int64)
    return Tracks([path], table.poses[off]), np.where(off, np.cumsum(off), 0).astype(np.int64)


def _events(
    folder: Path, camera: Camera, path: Stamped, *, event_unit: str | None, variant: Variant
) -> tuple[EventStream, Thresholds, dict[str, Note]]:
    """Events while poses are known, their thresholds, and remarks."""
    known_us = path.known_us(0)
    notes: dict[str, Note] = {}
    with open_events(folder / "events.h5", unit=event_unit, size=camera.size) as opened:
        file = opened if opened.unit else replace(opened, unit=variant.event_unit)
        if len(file):
            file.expect_overlap(
                known_us, known="poses", do="give the unit of the events, ns or us (`event_unit`)"
            )
        events = read_events(file, between=known_us)
        if len(file) > len(events):
            notes["events_outside_trajectory"] = float(len(file) - len(events))
        if file.unit == "ns":
            notes["event_times"] = "rounded from ns to us"
        stated = file.thresholds or (variant.threshold, variant.threshold)
    if (folder / "ev_map.npz").is_file():
        events = replace(events, site_colour=_site_colour(folder / "ev_map.npz", camera))
    return events, Thresholds(*stated), notes


def _site_colour(path: Path, camera: Camera) -> SiteColour:
    maps = load_arrays(path)
    shape = (camera.height, camera.width)
    for name in ("inv_mapx", "inv_mapy"):
        if name not in maps or maps[name].shape != shape:
            raise CaptureError(
                f"array {name} is missing, or differs from the sensor in size",
                where=path,
                got=", ".join(f"{key} {value.shape}" for key, value in maps.items()),
                do=f"it must be {shape}",
            )
    channel = np.tile(RGGB, (camera.height // 2 + 1, camera.width // 2 + 1))
    return SiteColour(
        maps["inv_mapx"].ravel().astype(np.float32),
        maps["inv_mapy"].ravel().astype(np.float32),
        channel[: camera.height, : camera.width].ravel(),
    )


def _truth(
    path: Path, names: tuple[str, ...], images: Shaped[np.ndarray, "n h w c"]
) -> tuple[Shaped[np.ndarray, "n h w c"] | None, Bool[np.ndarray, "n"] | None]:
    """Sharp images by name of the frame, and for which frames there is one."""
    if not path.exists():
        return None, None
    given = load_arrays(path)
    truth, known = np.zeros_like(images), np.isin(names, list(given))
    for i in np.flatnonzero(known):
        image = given[names[i]]
        if image.shape != images.shape[1:] or image.dtype != images.dtype:
            raise CaptureError(
                "a sharp image differs from the frame in size or type",
                where=f"{path}, {names[i]}",
                got=f"{image.dtype} {image.shape}, frame {images.dtype} {images.shape[1:]}",
                do="store sharp images with the size and type of the frames",
            )
        truth[i] = image
    return truth, known


def _expect_one_each(where: object, **counts: int) -> None:
    if len(set(counts.values())) > 1:
        raise CaptureError(
            f"there must be as many {' as '.join(counts)}",
            where=where,
            got=", ".join(f"{count} {name}" for name, count in counts.items()),
            do="check for images that were added or removed afterwards",
        )


LAYOUT = Layout(
    "ev-deblur-nerf",
    recognise,
    read,
    "poses_bounds.npy, all_poses_bounds.npy and events.h5",
    options=("event_unit",),
)
