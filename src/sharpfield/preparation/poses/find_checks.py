"""Check that the scene has enough depth variation for its poses to be well determined.

In front of a plane, translation and rotation look nearly alike, and so do a long focal length from
afar and a short one from nearby: a reconstruction of such a scene fits its images well and is still
wrong. *Relief* measures the depth variation: the share of the points that two distant images share
which depart from the best plane (homography) by more than the measurement error.

Source: Hartley and Zisserman, *Multiple View Geometry* (2003), sections 11.9 and 13.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from sharpfield.core.seed import evenly_spread
from sharpfield.preparation.poses.mapping import Intrinsics, SfmMap

PAIRS = 12
FAR = 0.75
"""Quantile of the distances of image pairs that share points; only pairs farther apart are used."""
SHARED, VIEWS = 20, 3
"""Two images must share so many points, each observed in so many images."""
TOLERANCE, LEAST_PX = 3.0, 1.0
"""A point is off a plane if its error is so many times that of the map, and so many px."""
LEAST_OFF = 0.1
"""Share of points off the plane below which the scene counts as flat."""


@dataclass(frozen=True)
class Relief:
    """How much the points depart from a plane."""

    off_plane: float
    """Share of the shared points that are off the best plane; median over image pairs."""
    tolerance_px: float
    """Largest error of a point on the plane."""
    thickness: float
    """Median distance of the points from the best plane, over their median depth."""
    pairs: int
    """Number of image pairs."""

    @property
    def flat(self) -> bool:
        """Whether a plane explains nearly all points."""
        return self.off_plane < LEAST_OFF


def relief(found: SfmMap) -> Relief | None:
    """Depth variation of a map; None if too few points are shared to measure it."""
    pairs = _pairs_far_apart(found)
    if not pairs:
        return None
    error_px = float(np.nanmean(found.error_px))
    tolerance_px = max(TOLERANCE * error_px, LEAST_PX)
    shares = [_off_plane(found, one, two, rows, tolerance_px) for one, two, rows in pairs]
    return Relief(float(np.median(shares)), tolerance_px, _thickness(found), len(pairs))


def advice(shown: Relief | None, intrinsics: Intrinsics) -> tuple[str, str] | None:
    """Warning about poses of a flat scene, and what to try; None if the scene is not flat."""
    if shown is None or not shown.flat:
        return None
    lens = intrinsics != "given"
    warning = (
        f"the scene is nearly flat: in distant images a plane explains"
        f" {100 * (1 - shown.off_plane):.0f} % of the points to {shown.tolerance_px:.1f} px, and"
        f" half of them are within {100 * shown.thickness:.1f} % of their depth from one plane;"
        f" camera positions{' and the focal length' if lens else ''} may be off by a tenth"
    )
    known = "give the focal length (ingest with --calibration, then --intrinsics given); "
    return warning, (
        f"{known if lens else ''}refine poses in training (train ev-splat --preset refine); record"
        " objects at other depths, and move farther sideways"
    )


def _pairs_far_apart(found: SfmMap) -> list[tuple[int, int, Int64[np.ndarray, "m"]]]:
    """Pairs of distant images that share points, and the indices of these points."""
    view, point = found.observations.T
    good = found.track_length[point] >= VIEWS
    shape = len(found.poses), len(found.points)
    seen = np.zeros(shape, np.float32)
    seen[view[good], point[good]] = 1
    shared = np.triu(seen @ seen.T, 1) >= SHARED  # [n, n], each pair once
    one, two = np.nonzero(shared)
    if not len(one):
        return []
    centre = found.poses[:, :, 3]
    apart = np.linalg.norm(centre[one] - centre[two], axis=-1)
    far = np.flatnonzero(apart >= np.quantile(apart, FAR))
    some = evenly_spread(far, PAIRS)
    return [(int(one[i]), int(two[i]), np.flatnonzero(seen[one[i]] * seen[two[i]])) for i in some]


def _off_plane(
    found: SfmMap, one: int, two: int, rows: Int64[np.ndarray, "m"], tolerance_px: float
) -> float:
    """Share of points whose positions in two images the best homography does not relate."""
    first, second = (_ideal_px(found, i, rows) for i in (one, two))
    cv2.setRNGSeed(0)
    _, explained = cv2.findHomography(first, second, cv2.RANSAC, tolerance_px)
    return 1.0 if explained is None else 1 - float(explained.mean())


def _ideal_px(found: SfmMap, view: int, rows: Int64[np.ndarray, "m"]) -> Float64[np.ndarray, "m 2"]:
    """Projections of points by a pinhole camera without distortion."""
    pose = found.poses[view]
    local = (found.points[rows] - pose[:, 3]) @ pose[:, :3]
    return found.camera.fx_px * local[:, :2] / local[:, 2:]


def _thickness(found: SfmMap) -> float:
    """Median distance from the plane fitted to the closest half of the points, over their depth."""
    good = found.points[found.track_length >= VIEWS]
    kept = np.ones(len(good), bool)
    distance = np.zeros(len(good))
    for _ in range(5):  # trimmed: a few objects in front of a wall do not tilt it
        centre = good[kept].mean(0)
        normal = np.linalg.svd(good[kept] - centre, full_matrices=False)[2][2]
        distance = np.abs((good - centre) @ normal)
        kept = distance <= np.median(distance)
    view, point = found.observations.T
    toward = found.points[point] - found.poses[view, :, 3]
    return float(np.median(distance) / np.median((toward * found.poses[view, :, 2]).sum(-1)))
