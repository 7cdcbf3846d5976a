"""Normalised worlds of a capture.

- `normalised`: the nearest depth becomes 4/3, the average camera the origin.
- `recentred`: what the cameras look at lies in a box from -1 to 1. For cameras all around a scene,
  whose average pose is meaningless.
"""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float

from sharpfield.core.capture import Capture
from sharpfield.geometry.space import Similarity, normalisation
from sharpfield.geometry.trajectory import (
    LearnedExposureMotion,
    LearnedKnots,
    Moved,
    Stamped,
    Tracks,
    count_tracks,
)

PARALLEL = 1e-3
"""Mean squared sine of the angles between optical axes below which they count as parallel."""


def focus(poses: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3"] | None:
    """The point nearest to all optical axes, in the least-squares sense.

    None if the axes are nearly parallel, or if the point is behind most cameras.
    """
    centre, forward = poses[:, :, 3], poses[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # removes what is along an axis
    system = across.mean(0)
    if np.linalg.eigvalsh(system)[0] < PARALLEL:
        return None
    right = (across @ centre[..., None]).mean(0)[:, 0]
    point = np.asarray(np.linalg.solve(system, right), np.float64)  # pyright: ignore
    before = ((point - centre) * forward).sum(-1) > 0
    return point if before.mean() > 0.5 else None


PATH_SAMPLES = 256
"""Instants at which a trajectory without frames is sampled."""


def reference_poses(capture: Capture) -> Float[np.ndarray, "n 3 4"]:
    """The poses over which a capture is normalised: its frames', or those of its moving track.

    Published data sets average over one or the other, see `Capture.known.reference_poses`. Without
    frames it is the trajectory, of all cameras if they are static.
    """
    known = capture.trajectory.known_us(0)
    along = capture.known.reference_poses == "trajectory" or capture.frames is None
    if along and known is not None:
        path = capture.trajectory
        path = path.moving[0] if isinstance(path, Tracks) else path
        if isinstance(path, Stamped):
            return path.poses
        start, end = (float(capture.clock.unit(t)) for t in known)
        time = torch.linspace(start, end, PATH_SAMPLES)
        along_it = capture.trajectory.pose(time, torch.zeros(PATH_SAMPLES, dtype=torch.int64))
        return along_it.detach().double().numpy()
    if capture.frames is None:  # static cameras
        track = torch.arange(count_tracks(capture.trajectory))
        return capture.trajectory.pose(torch.zeros(len(track)), track).detach().double().numpy()
    every = np.arange(len(capture.frames))
    return capture.frame_pose(every).detach().double().numpy()


def normalised(capture: Capture) -> tuple[Capture, Similarity]:
    """The capture in its normalised world, and the similarity that leads there."""
    change = normalisation(reference_poses(capture), capture.near)
    return moved(capture, change), change


def moved(capture: Capture, change: Similarity) -> Capture:
    """A capture in another world."""
    frames = capture.frames
    if frames is not None and frames.depth is not None:
        frames = dataclasses.replace(frames, depth=frames.depth * np.float32(change.scale))
    depth = capture.depth
    if depth is not None:
        depth = dataclasses.replace(depth, unit=depth.unit * change.scale)
    return dataclasses.replace(
        capture,
        trajectory=Moved(capture.trajectory, change),
        near=capture.near * change.scale,
        far=capture.far * change.scale,
        frames=frames,
        depth=depth,
        points=None if capture.points is None else change.points(capture.points),
    )


def change_of(capture: Capture) -> Similarity:
    """The similarity that a normalised capture was transformed by; of any other, the identity.

    It maps the world of the capture on disk, in which a camera path may be given, to that of a
    model.
    """
    path: object = capture.trajectory
    while isinstance(path, LearnedKnots | LearnedExposureMotion):
        path = path.base
    if isinstance(path, Moved):
        return path.change
    return Similarity(1.0, np.eye(3), np.zeros(3))


def recentred(capture: Capture) -> tuple[Capture, Similarity]:
    """The capture in a world in which its cameras look at a box from -1 to 1.

    The box is as wide as the field of view around the point that all cameras look at, and no part
    of it is nearer than the capture's nearest depth. Where there is no such point, it is half way
    between the nearest and the farthest depth.
    """
    poses = reference_poses(capture)
    centre, forward = poses[:, :, 3], poses[:, :, 2]
    point = focus(poses)
    if point is None:
        point = (centre + (capture.near + capture.far) / 2 * forward).mean(0)
    distance = float(np.linalg.norm(centre - point, axis=1).mean())
    camera = capture.camera
    view = distance * max(camera.width / camera.fx_px, camera.height / camera.fy_px) / 2
    half = min(view, max(distance - capture.near, 0.1 * distance))
    change = Similarity(1 / half, np.eye(3), -point / half)
    return moved(capture, change), change
