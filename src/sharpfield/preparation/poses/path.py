"""From poses of images to a trajectory over time.

The trajectory of a moving camera is a cubic spline through the poses found, with SLERP for the
rotation. It is extrapolated to the opening of the first shutter and the closing of the last one, at
the speed of the nearest segment. Photos, each on a track of its own, have a constant pose.

Images determine world coordinates only up to a similarity. By default the average camera is at the
origin and looks along z, and the median depth of the points is one. Measured depth gives a metric
scale. Known poses define the world instead.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry import se3
from sharpfield.geometry.space import Similarity, average_pose
from sharpfield.geometry.trajectory import Stamped, Still, Tracks
from sharpfield.metrics.pose import PoseError, absolute_error, align, relative_error
from sharpfield.preparation.poses.mapping import SfmMap

MAX_EXTRAPOLATION = 1.0
"""Longest extrapolation, in intervals between the last two poses."""


def moving_tracks(frames: Frames) -> Int64[np.ndarray, "k"]:
    """Tracks with several frames: cameras that may have moved."""
    tracks, count = np.unique(frames.track, return_counts=True)
    return tracks[count > 1]


def extrapolated(
    times_us: Int64[np.ndarray, "p"],
    poses: Float64[np.ndarray, "p 3 4"],
    window_us: tuple[int, int],
) -> tuple[Int64[np.ndarray, "q"], Float64[np.ndarray, "q 3 4"]]:
    """World-from-camera poses with one more at either end, to cover a window as far as allowed.

    There are at least two, in ascending order of time.
    """
    begin = max(window_us[0], int(times_us[0] - MAX_EXTRAPOLATION * (times_us[1] - times_us[0])))
    end = min(window_us[1], int(times_us[-1] + MAX_EXTRAPOLATION * (times_us[-1] - times_us[-2])))
    if begin < times_us[0]:
        first = _beyond(poses[1], poses[0], (times_us[0] - begin) / (times_us[1] - times_us[0]))
        times_us, poses = np.insert(times_us, 0, begin), np.insert(poses, 0, first, axis=0)
    if end > times_us[-1]:
        last = _beyond(poses[-2], poses[-1], (end - times_us[-1]) / (times_us[-1] - times_us[-2]))
        times_us, poses = np.append(times_us, end), np.append(poses, last[None], axis=0)
    return times_us, poses


@dataclass(frozen=True)
class FramesOnPath:
    """A trajectory, and the frames on it."""

    frames: Frames | None
    """Frames with a pose; their tracks are renumbered."""
    path: Stamped | Still | Tracks
    kept: Int64[np.ndarray, "m"]
    """Their indices in the capture."""
    track_of: Int64[np.ndarray, "k"]
    """New number of each old track, -1 for those without poses."""


def path_through(
    frames: Frames,
    frame: Int64[np.ndarray, "n"],
    time_us: Int64[np.ndarray, "n"],
    poses: Float64[np.ndarray, "n 3 4"],
    clock: Clock,
) -> FramesOnPath:
    """The trajectory of all cameras, through the world-from-camera pose of each `frame` index."""
    moving, standing = list[Stamped](), list[int]()
    track_of = np.full(int(frames.track.max()) + 1, -1)
    on_path = np.zeros(len(frames), bool)
    for one in moving_tracks(frames):
        own = np.flatnonzero(frames.track[frame] == one)
        member = np.flatnonzero(frames.track == one)
        times, first = np.unique(time_us[own], return_index=True)
        if len(times) < 2:
            continue
        opens, closes = frames.exposure.open_us[member], frames.exposure.close_us[member]
        window = int(opens.min()), int(closes.max())
        times, through = extrapolated(times, poses[own[first]], window)
        on_path[member] = (opens >= times[0]) & (closes <= times[-1])
        track_of[one] = len(moving)
        moving.append(Stamped(times, through, clock))
    for one in np.setdiff1d(frames.track, moving_tracks(frames)):
        own = np.flatnonzero(frames.track[frame] == one)
        if len(own):
            on_path[frame[own[0]]] = True
            track_of[one] = len(moving) + len(standing)
            standing.append(int(own[0]))
    still = poses[np.array(standing, np.int64)]
    kept = np.flatnonzero(on_path)
    path = Still(still) if not moving else Tracks(moving, still)
    if len(moving) == 1 and not standing:
        path = moving[0]
    return FramesOnPath(
        frames_on_tracks(frames, kept, track_of[frames.track[kept]]), path, kept, track_of
    )


def capture_on_path(
    capture: Capture, laid: FramesOnPath, *, without: Int64[np.ndarray, "u"] | None = None
) -> Capture:
    """A capture with another trajectory: only frames and events that it covers are kept.

    Args:
        capture: Poses it has are not used.
        laid: The trajectory, and the frames on it.
        without: Frames whose pose is unsure: neither trained on nor held out.
    """
    depth, parts = capture.depth, (capture.split.train, capture.split.test)
    sure = ~np.isin(laid.kept, np.zeros(0, int) if without is None else without)
    return replace(
        capture,
        trajectory=laid.path,
        frames=laid.frames,
        split=Split(*(np.flatnonzero(sure & np.isin(laid.kept, part)) for part in parts)),
        depth=None if depth is None else replace(depth, stored=depth.stored[laid.kept]),
        events=_events_on_path(capture.events, laid),
        test_events=_events_on_path(capture.test_events, laid),
    )


def _events_on_path(events: EventStream | None, laid: FramesOnPath) -> EventStream | None:
    """Events of tracks and times with known poses, their tracks renumbered."""
    if events is None:
        return None
    if events.track is not None:
        track = laid.track_of[np.asarray(events.track, np.int64)]
        there = np.flatnonzero(track >= 0)
        renumbered, tracks = track[there].astype(np.uint16), int(laid.track_of.max()) + 1
        events = replace(events[there], track=renumbered, tracks=tracks)
    spans = [span for t in range(events.tracks) if (span := laid.path.known_us(t)) is not None]
    if not spans:
        return events
    return events.window(min(s[0] for s in spans), max(s[1] for s in spans) + 1)


def _beyond(
    before: Float64[np.ndarray, "3 4"], last: Float64[np.ndarray, "3 4"], share: float
) -> Float64[np.ndarray, "3 4"]:
    """The last pose, extrapolated by a share of the motion that led to it."""
    one, two = torch.from_numpy(before), torch.from_numpy(last)
    turn = se3.rotation_log(two[:, :3] @ one[:, :3].mT)
    rotation = se3.rotation_exp(share * turn) @ two[:, :3]
    position = two[:, 3:] + share * (two[:, 3:] - one[:, 3:])
    return torch.cat([rotation, position], -1).numpy()


def frames_on_tracks(
    frames: Frames, chosen: Int64[np.ndarray, "m"], track: Int64[np.ndarray, "m"]
) -> Frames:
    """Some of the frames, on new tracks; without depth, whose units are those of another world."""
    return replace(
        frames,
        images=frames.images[chosen],
        exposure=Exposure(frames.exposure.open_us[chosen], frames.exposure.close_us[chosen]),
        track=track,
        names=tuple(frames.names[i] for i in chosen),
        truth=None if frames.truth is None else frames.truth[chosen],
        truth_known=None if frames.truth_known is None else frames.truth_known[chosen],
        depth=None,
        flow=None if frames.flow is None else frames.flow[chosen],
        blur_px=None if frames.blur_px is None else frames.blur_px[chosen],
    )


MEDIAN_DEPTH = 1.0


@dataclass(frozen=True)
class PoseErrors:
    """Differences of found poses from known ones, after the best similarity."""

    absolute: PoseError
    """Absolute trajectory error."""
    relative: PoseError
    """Relative pose error, from image to image."""


def centred_world(found: SfmMap) -> Similarity:
    """Average camera at the origin, median depth of the points 1."""
    centre = average_pose(found.poses[found.registered])
    scale = MEDIAN_DEPTH / float(np.median(depths(found)))
    rotation = centre[:, :3].T
    return Similarity(scale, rotation, -scale * rotation @ centre[:, 3])


def measured_world(found: SfmMap, capture: Capture, frame: Int64[np.ndarray, "n"]) -> Similarity:
    """The same, scaled to the units of the measured depth.

    Raises:
        CaptureError: No point projects to a pixel with measured depth.
    """
    maps, ratio = capture.needed_depth, list[float]()
    for view in np.flatnonzero(found.registered):
        pose = found.poses[view]
        points = found.points[found.observations[found.observations[:, 0] == view, 1]]
        local = (points - pose[:, 3]) @ pose[:, :3]
        local = local[local[:, 2] > 0]
        xy = maps.camera.project(torch.from_numpy(local)).numpy().astype(np.int64)
        inside = (xy >= 0).all(-1) & (xy < maps.camera.size).all(-1)
        measured = maps.at(int(frame[view]))[xy[inside, 1], xy[inside, 0]]
        ratio += (measured / local[inside, 2])[measured > 0].tolist()
    if not ratio:
        raise CaptureError("no point projects to a pixel with measured depth", where=capture.name)
    base = centred_world(found)
    factor = float(np.median(ratio)) / base.scale
    return Similarity(base.scale * factor, base.rotation, base.translation * factor)


def known_world(
    found: SfmMap, known: Float64[np.ndarray, "n 3 4"]
) -> tuple[Similarity, PoseErrors]:
    """The similarity to the world of known poses (NaN where unknown), and the errors left (RMS).

    Raises:
        CaptureError: Fewer than three images have both poses.
    """
    both = found.registered & np.isfinite(known).all((1, 2))
    if both.sum() < 3:
        raise CaptureError(
            "too few images have a pose in the file to align to",
            got=f"{both.sum()}, at least 3 are needed",
            do="check the clock of the file: --offset-ms moves it",
        )
    estimate, truth = (torch.from_numpy(poses[both]) for poses in (found.poses, known))
    change = align(estimate, truth)
    similarity = Similarity(change.scale, change.rotation.numpy(), change.translation.numpy())
    return similarity, PoseErrors(absolute_error(estimate, truth), relative_error(estimate, truth))


def depths(found: SfmMap) -> Float64[np.ndarray, "o"]:
    """Depth of each observation along the optical axis."""
    view, point = found.observations.T
    toward = found.points[point] - found.poses[view, :, 3]
    return (toward * found.poses[view, :, 2]).sum(-1)
