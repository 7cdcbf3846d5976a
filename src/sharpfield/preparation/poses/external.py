"""Attach external poses to a capture: of other programs, motion capture, motor encoders.

A pose file tracks a *body* on its own clock. The pose of the camera is that of the body times the
hand-eye transform (body-from-camera); a time of the capture is a time of the file plus an offset.
Frames and events that the trajectory does not cover are left out.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.captures.layouts._photos import depth_bounds, same_camera, scaled_camera
from sharpfield.captures.trajectory_files import ExternalPath
from sharpfield.core.capture import Capture, Clock
from sharpfield.core.errors import CaptureError
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped
from sharpfield.geometry.two_views import depths_of, find_features, match_pairs, pairs_apart
from sharpfield.preparation.poses.images import sfm_images
from sharpfield.preparation.poses.path import (
    FramesOnPath,
    capture_on_path,
    frames_on_tracks,
    path_through,
)

PAIRS = 12
BOUNDS_PERCENT, BOUNDS_MARGIN = (1.0, 99.0), 1.2
"""Near and far are these percentiles of the depth of matched features, with a margin."""


@dataclass(frozen=True)
class Mount:
    """How a tracked body relates to the camera."""

    offset_us: int = 0
    """Added to times of the file to get times of the capture."""
    body_from_camera: Float64[np.ndarray, "3 4"] | None = None
    """Hand-eye transform; None if the file tracks the camera itself."""


@dataclass(frozen=True)
class Attached:
    """A capture with external poses."""

    capture: Capture
    kept: Int64[np.ndarray, "m"]
    """Indices of the frames of the original capture that are in it."""
    covered_us: tuple[int, int] | None
    """Time span of the poses; None if the cameras do not move."""


def attach(
    capture: Capture, path: ExternalPath, mount: Mount, *, bounds: tuple[float, float] | None = None
) -> Attached:
    """The capture with the poses of a file.

    Args:
        capture: Poses it has are not used.
        path: Poses of the file.
        mount: Time offset and hand-eye transform.
        bounds: Near and far; by default those of the capture, or where these are unknown, from
            matched features of the frames.

    Raises:
        CaptureError: Times or names do not fit, or bounds are unknown and cannot be found.
    """
    poses = _mounted(path.poses, mount)
    laid = _timed(capture, path, poses, mount) if path.times_us is not None else None
    if laid is None:
        frame, poses = _by_frame(capture, path, poses)
        middle = capture.needed_frames.exposure.middle_us[frame]
        laid = path_through(capture.needed_frames, frame, middle, poses, capture.clock)
    made = replace(
        capture_on_path(capture, laid),
        known=replace(capture.known, poses="known", bounds="known"),
        notes=capture.notes | {"poses_from": f"a file ({path.layout})"},
    )
    made = _with_model(made, path)
    if bounds is None and capture.known.bounds == "unknown" and path.model is None:
        bounds = _seen_bounds(made)
    if bounds is not None:
        made = replace(made, near=bounds[0], far=bounds[1])
    return Attached(made, laid.kept, laid.path.known_us(0))


def known_at(
    path: ExternalPath, mount: Mount, times_us: Int64[np.ndarray, "n"]
) -> Float64[np.ndarray, "n 3 4"]:
    """Poses of the camera at some times of the capture; NaN outside the time of the file.

    Raises:
        CaptureError: The file has no times.
    """
    if path.times_us is None:
        raise CaptureError("poses without times cannot be looked up by time", got=path.layout)
    stamps, poses = path.times_us + mount.offset_us, _mounted(path.poses, mount)
    clock = Clock(int(stamps[0]), max(int(stamps[-1] - stamps[0]), 1))
    along = Stamped(stamps, poses, clock)
    unit = torch.from_numpy(clock.unit(times_us))
    found = along.pose(unit, torch.zeros(len(unit), dtype=torch.int64)).numpy()
    outside = (times_us < stamps[0]) | (times_us > stamps[-1])
    return np.where(outside[:, None, None], np.nan, found)


def _mounted(poses: Float64[np.ndarray, "p 3 4"], mount: Mount) -> Float64[np.ndarray, "p 3 4"]:
    if mount.body_from_camera is None:
        return poses
    hand = torch.from_numpy(mount.body_from_camera).expand(len(poses), 3, 4)
    return se3.compose(torch.from_numpy(poses), hand).numpy()


def _timed(
    capture: Capture, path: ExternalPath, poses: Float64[np.ndarray, "p 3 4"], mount: Mount
) -> FramesOnPath:
    """Everything that the path covers; there must be one camera."""
    assert path.times_us is not None, "checked by the caller"
    stamps = path.times_us + mount.offset_us
    span, laid_path = (int(stamps[0]), int(stamps[-1])), Stamped(stamps, poses, capture.clock)
    frames = capture.frames
    if frames is None:
        _expect_some(capture, stamps, len(capture.needed_events.window(*span)))
        return FramesOnPath(None, laid_path, np.zeros(0, np.int64), np.zeros(1, np.int64))
    if len(np.unique(frames.track)) > 1:
        raise CaptureError(
            "a file of one path cannot give poses to several cameras",
            where=capture.name,
            got=f"{len(np.unique(frames.track))} tracks",
            do="give a COLMAP model, whose poses belong to images",
        )
    inside = (frames.exposure.open_us >= stamps[0]) & (frames.exposure.close_us <= stamps[-1])
    _expect_some(capture, stamps, int(inside.sum()))
    kept = np.flatnonzero(inside)
    track_of = np.zeros(int(frames.track.max()) + 1, np.int64)
    return FramesOnPath(
        frames_on_tracks(frames, kept, np.zeros(len(kept), np.int64)), laid_path, kept, track_of
    )


def _expect_some(capture: Capture, stamps: Int64[np.ndarray, "p"], covered: int) -> None:
    if covered:
        return
    frames, events = capture.frames, capture.events
    if frames is not None:
        begin, end = int(frames.exposure.open_us.min()), int(frames.exposure.close_us.max())
    else:
        assert events is not None, "a capture has frames or events"
        begin, end = int(events.t_us[0]), int(events.t_us[-1])
    raise CaptureError(
        "the trajectory and the capture were not taken at the same time",
        where=capture.name,
        got=f"poses from {stamps[0]} to {stamps[-1]} us, capture from {begin} to {end} us",
        do=f"give the offset of the clocks; --offset-ms {(begin - int(stamps[0])) / 1000:.0f} makes"
        " both begin together",
    )


def _by_frame(
    capture: Capture, path: ExternalPath, poses: Float64[np.ndarray, "p 3 4"]
) -> tuple[Int64[np.ndarray, "n"], Float64[np.ndarray, "n 3 4"]]:
    """Which frames poses without times belong to: by name, or one for each in order."""
    frames = capture.needed_frames
    if path.names is None:
        if len(poses) != len(frames):
            raise CaptureError(
                "poses without times must be as many as the frames",
                where=capture.name,
                got=f"{len(poses)} poses, {len(frames)} frames",
                do="put a times.txt (seconds, a line per pose) beside the file",
            )
        return np.lexsort((frames.exposure.middle_us, frames.track)), poses
    row_of = {name.rsplit("/", 1)[-1]: row for row, name in enumerate(path.names)}
    found = [(i, row_of[name]) for i, name in enumerate(frames.names) if name in row_of]
    if not found:
        raise CaptureError(
            "no image of the model is a frame of the capture",
            where=capture.name,
            got=f"{path.names[0]}, ..., frames {frames.names[0]}, ...",
            do="name the images like the frames",
        )
    frame, row = np.array(found, np.int64).T
    return frame, poses[row]


def _with_model(capture: Capture, path: ExternalPath) -> Capture:
    """Points, depth bounds and, where it is unknown, the lens of a reconstruction."""
    model = path.model
    if model is None or not len(model.points):
        return capture
    near, far = depth_bounds(model.points, model.poses, model.seen, where=capture.name)
    camera = capture.camera
    if capture.known.intrinsics == "unknown":
        shared = same_camera(model.cameras, model.names, where=capture.name)
        camera = scaled_camera(shared, camera.width, camera.height, where=capture.name)
    return replace(
        capture,
        camera=camera,
        points=model.points,
        near=near,
        far=far,
        known=replace(capture.known, intrinsics="known"),
    )


def _seen_bounds(capture: Capture) -> tuple[float, float]:
    """Near and far, from details that several frames show."""
    unknown = CaptureError(
        "near and far of the scene are unknown, and the frames do not show them",
        where=capture.name,
        do="give --near and --far, in units of the trajectory",
    )
    if capture.frames is None:
        raise unknown
    sharp = sfm_images(capture, "auto")
    time = torch.from_numpy(capture.clock.unit(sharp.time_us))
    track = torch.from_numpy(capture.frames.track[sharp.frame])
    poses = capture.trajectory.pose(time, track).detach().double().numpy()
    pairs = pairs_apart(poses, most=PAIRS)
    found = []
    for matches in match_pairs(find_features(sharp.images), pairs):
        depth, sure = depths_of(matches, capture.camera, poses)
        found += depth[sure].tolist()
    if not found:
        raise unknown
    near, far = np.percentile(found, BOUNDS_PERCENT)
    return float(near) / BOUNDS_MARGIN, float(far) * BOUNDS_MARGIN
