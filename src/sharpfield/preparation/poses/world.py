"""Which world poses are written in: images alone leave its scale, place and direction open.

By default the average camera is the origin and looks along z, and the points seen lie at a median
depth of one. Where depth was measured, it gives the scale. Where positions are known from
elsewhere, the world is theirs.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.geometry.space import Similarity, average_pose
from sharpfield.metrics.pose import align
from sharpfield.preparation.poses.mapping import Map

MEDIAN_DEPTH = 1.0


@dataclass(frozen=True)
class Known:
    """Where the camera was at the instants of the images, as something else says."""

    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera; NaN where unknown."""


def own_world(found: Map) -> Similarity:
    """Average camera at the origin, median depth of the points one."""
    centre = average_pose(found.poses[found.registered])
    scale = MEDIAN_DEPTH / float(np.median(depths(found)))
    rotation = centre[:, :3].T
    return Similarity(scale, rotation, -scale * rotation @ centre[:, 3])


def measured_world(found: Map, capture: Capture, frame: Int64[np.ndarray, "n"]) -> Similarity:
    """The same in the units of the depth that was measured beside the frames.

    Raises:
        CaptureError: No point lies where depth was measured.
    """
    maps, ratio = capture.needed_depth, list[float]()
    for view in np.flatnonzero(found.registered):
        pose, seen = (
            found.poses[view],
            found.points[found.observations[found.observations[:, 0] == view, 1]],
        )
        local = (seen - pose[:, 3]) @ pose[:, :3]
        local = local[local[:, 2] > 0]
        xy = maps.camera.project(torch.from_numpy(local)).numpy().astype(np.int64)
        inside = (xy >= 0).all(-1) & (xy < maps.camera.size).all(-1)
        measured = maps.at(int(frame[view]))[xy[inside, 1], xy[inside, 0]]
        ratio += (measured / local[inside, 2])[measured > 0].tolist()
    if not ratio:
        raise CaptureError("no point lies where depth was measured", where=capture.name)
    base = own_world(found)
    factor = float(np.median(ratio)) / base.scale
    return Similarity(base.scale * factor, base.rotation, base.translation * factor)


def known_world(found: Map, known: Known) -> tuple[Similarity, float]:
    """The change to the world of known poses, and how far camera centres then are from them.

    Returns:
        The change, and the root mean square distance in units of that world.

    Raises:
        CaptureError: Fewer than three images have both poses.
    """
    both = found.registered & np.isfinite(known.poses).all((1, 2))
    if both.sum() < 3:
        raise CaptureError(
            "too few images have a pose in the file to align to",
            got=f"{both.sum()}, at least 3 are needed",
            do="check the clock of the file: --offset-ms moves it",
        )
    estimate, truth = (torch.from_numpy(poses[both]) for poses in (found.poses, known.poses))
    change = align(estimate, truth)
    apart = change(estimate)[..., 3] - truth[..., 3]
    similarity = Similarity(change.scale, change.rotation.numpy(), change.translation.numpy())
    return similarity, float(apart.square().sum(-1).mean().sqrt())


def depths(found: Map) -> Float64[np.ndarray, "o"]:
    """Depth of each sighting along its camera's axis."""
    view, point = found.observations.T
    toward = found.points[point] - found.poses[view, :, 3]
    return (toward * found.poses[view, :, 2]).sum(-1)
