"""World coordinates of found poses: images determine them only up to a similarity.

By default the average camera is at the origin and looks along z, and the median depth of the points
is one. Measured depth gives a metric scale. KnownPoses positions define the world instead.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.geometry.space import Similarity, average_pose
from sharpfield.metrics.pose import PoseError, absolute_error, align, relative_error
from sharpfield.preparation.poses.mapping import SfmMap

MEDIAN_DEPTH = 1.0


@dataclass(frozen=True)
class PoseErrors:
    """Differences of found poses from known ones, after the best similarity."""

    absolute: PoseError
    """Absolute trajectory error."""
    relative: PoseError
    """Relative pose error, from image to image."""


@dataclass(frozen=True)
class KnownPoses:
    """KnownPoses poses at the instants of the images."""

    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera; NaN where unknown."""


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


def known_world(found: SfmMap, known: KnownPoses) -> tuple[Similarity, PoseErrors]:
    """The similarity to the world of known poses, and the remaining differences.

    Returns:
        The similarity, and the absolute trajectory error and relative pose error (RMS).

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
    similarity = Similarity(change.scale, change.rotation.numpy(), change.translation.numpy())
    return similarity, PoseErrors(absolute_error(estimate, truth), relative_error(estimate, truth))


def depths(found: SfmMap) -> Float64[np.ndarray, "o"]:
    """Depth of each observation along the optical axis."""
    view, point = found.observations.T
    toward = found.points[point] - found.poses[view, :, 3]
    return (toward * found.poses[view, :, 2]).sum(-1)
