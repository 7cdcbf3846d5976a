"""Find the poses of a capture from its frames, deblurred by its events where there are any.

    sharp images  ->  map of points and poses  ->  world coordinates  ->  trajectory over time

Frames without a pose between others stay in the capture, on the trajectory, but are neither trained
on nor held out. Frames and events before the start or after the end of the trajectory are left out.

In front of a plane, translation and rotation look nearly alike, and so do a long focal length from
afar and a short one from nearby: a reconstruction of such a scene fits its images well and is still
wrong. So the *relief*, the depth variation of the scene, is measured: the share of the points that
two distant images share which depart from the best plane (homography) by more than the measurement
error.

Source: Hartley and Zisserman, *Multiple View Geometry* (2003), sections 11.9 and 13.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.seed import evenly_spread
from sharpfield.preparation.options import ImageSource, PoseOptions
from sharpfield.preparation.poses.images import SfmImages, sfm_images
from sharpfield.preparation.poses.mapping import (
    MIN_FEATURES,
    MIN_INLIERS,
    Intrinsics,
    LensTask,
    MatchCounts,
    SfmMap,
    map_images,
)
from sharpfield.preparation.poses.path import (
    FramesOnPath,
    PoseErrors,
    capture_on_path,
    centred_world,
    depths,
    known_world,
    measured_world,
    path_through,
)

PAIRS = 12
FAR = 0.75
"""Quantile of the distances of image pairs that share points; only pairs farther apart are used."""
SHARED = 20
"""Two images must share so many points."""
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
    first, second = (
        found.camera.fx_px * local[:, :2] / local[:, 2:]  # pinhole projections, undistorted
        for pose in found.poses[[one, two]]
        for local in ((found.points[rows] - pose[:, 3]) @ pose[:, :3],)
    )
    cv2.setRNGSeed(0)
    _, explained = cv2.findHomography(first, second, cv2.RANSAC, tolerance_px)
    return 1.0 if explained is None else 1 - float(explained.mean())


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
    return float(np.median(distance) / np.median(depths(found)))


INSTANTS, MAX_IMAGES = 3, 120
"""Images of each exposure, fewer if there would be more than `MAX_IMAGES` in total."""

MIN_REGISTERED = 0.5
"""Smallest share of registered images; below, finding poses fails."""

PLANAR = 0.9
"""Share of planar pairs from which on the scene or the motion is reported as degenerate."""

ERROR_PX, VIEWS = 1.5, 3
"""Largest reprojection error and fewest images of the points that are kept."""

BOUNDS_PERCENT = (0.5, 99.5)
BOUNDS_MARGIN = 1.1
"""Near and far are these percentiles of the depth of all observations, with a margin."""


KnownAt = Callable[[Int64[np.ndarray, "n"]], Float64[np.ndarray, "n 3 4"]]
"""Gives known world-from-camera poses at some times of the capture, in us; NaN where unknown."""


@dataclass(frozen=True)
class Failure:
    """An image without a pose: why, and what to try."""

    image: int
    why: str
    do: str


@dataclass(frozen=True)
class PosesFound:
    """A capture with poses, and the map they come from."""

    capture: Capture
    images: SfmImages
    """The images the poses were found from."""
    map: SfmMap
    """In the world of the capture."""
    counts: MatchCounts
    failures: tuple[Failure, ...]
    kept: Int64[np.ndarray, "m"]
    """Indices of the frames of the original capture that are in the new one."""
    intrinsics: Intrinsics
    relief: Relief | None
    """Depth variation of the scene; None if the images share too few points to measure it."""
    errors: PoseErrors | None = None
    """Differences from known poses, where there are some."""


def find_poses(
    capture: Capture, options: PoseOptions, *, known: KnownAt | None = None
) -> PosesFound:
    """The capture with poses, points, depth bounds and, if they were unknown, intrinsics.

    Args:
        capture: With frames. Poses it has are not used.
        options: Options.
        known: Known poses at some times of the capture, which define the world coordinates.

    Raises:
        CaptureError: Poses could not be found; the message says why and what to try.
        MissingExtra: pycolmap is not installed.
    """
    images = sfm_images(
        capture, options.images, instants=options.instants or _instants(capture, options.images)
    )
    default = "find" if capture.known.intrinsics == "unknown" else "given"
    intrinsics: Intrinsics = options.intrinsics or default
    task = LensTask(capture.camera, intrinsics, options.lens)
    found, counts = map_images(images.images, task, seed=options.seed)
    if found is None or found.registered.sum() < max(3, MIN_REGISTERED * len(images)):
        raise _failed(capture, images, found, counts)
    errors = None
    if known is not None:
        change, errors = known_world(found, known(images.time_us))
    elif capture.depth is not None:
        change = measured_world(found, capture, images.frame)
    else:
        change = centred_world(found)
    poses = found.poses.copy()
    poses[found.registered] = change.poses(found.poses[found.registered])
    found = replace(found, poses=poses, points=change.points(found.points))
    made, laid = _with_poses(capture, images, found, intrinsics)
    failures = tuple(
        Failure(int(i), *_why(int(i), images, counts)) for i in np.flatnonzero(~found.registered)
    )
    return PosesFound(
        made, images, found, counts, failures, laid.kept, intrinsics, relief(found), errors
    )


def _instants(capture: Capture, source: ImageSource) -> int:
    """Images of each exposure: the motion during long exposures is not linear."""
    blurred = int((~capture.needed_frames.exposure.instant).sum())
    if capture.events is None or not blurred or source not in ("auto", "edi"):
        return 1
    return max(min(INSTANTS, MAX_IMAGES // blurred), 1)


def _with_poses(
    capture: Capture, images: SfmImages, found: SfmMap, intrinsics: Intrinsics
) -> tuple[Capture, FramesOnPath]:
    there = found.registered
    laid = path_through(
        capture.needed_frames, images.frame[there], images.time_us[there], found.poses[there],
        capture.clock,
    )  # fmt: skip
    good = (found.point_error_px < ERROR_PX) & (found.track_length >= VIEWS)
    good = good if good.any() else np.ones_like(good)
    near, far = np.percentile(depths(found)[good[found.observations[:, 1]]], BOUNDS_PERCENT)
    unsure = np.setdiff1d(np.arange(len(capture.needed_frames)), images.frame[there])
    made = replace(
        capture_on_path(capture, laid, without=unsure),
        camera=found.camera,
        near=float(near) / BOUNDS_MARGIN,
        far=float(far) * BOUNDS_MARGIN,
        points=found.points[good],
        known=replace(capture.known, poses="known", intrinsics="known", bounds="known"),
        notes=capture.notes
        | {"poses_from": f"structure from motion, {images.source}, {intrinsics} lens"},
    )
    return made, laid


def _why(image: int, images: SfmImages, counts: MatchCounts) -> tuple[str, str]:
    """Why an image has no pose, and what to try."""
    features, matches = int(counts.features[image]), int(counts.matches[image])
    if features < MIN_FEATURES:
        why = f"only {features} features: it is dark, blurred or has little texture"
        do = (
            "use the events: --images edi"
            if images.source != "edi"
            else "check the thresholds with `sharpfield calibrate`, or leave the frame out"
        )
        return why, do
    if matches < MIN_INLIERS:
        return (
            f"{features} features, but no other image matches them",
            "take images closer together, --instants 3, or leave the frame out",
        )
    return (
        f"{matches} matches, but too few of them are points of the map",
        "take more images around it, or --instants 3",
    )


def _failed(
    capture: Capture, images: SfmImages, found: SfmMap | None, counts: MatchCounts
) -> CaptureError:
    """The error when no images, or too few, could be registered."""
    count = 0 if found is None else int(found.registered.sum())
    features, matches = np.median(counts.features), np.median(counts.matches)
    got = (
        f"{count} of {len(images)} images registered; the median image has {features:.0f} features"
        f" and {matches:.0f} matches"
    )
    tries = []
    if images.source != "edi" and capture.events is not None:
        tries.append("deblur with the events first (--images edi)")
    if features < MIN_FEATURES:
        why = "the images have too few features: dark, blurred or without texture"
        tries.append("light the scene, shorten the exposure, or add texture to it")
    elif matches < MIN_INLIERS:
        why = "the images have too little in common"
        tries.append("take them closer together, or several per exposure (--instants 3)")
    elif counts.planar_pairs > PLANAR:
        why = "a plane or a pure rotation explains all matches, so depth cannot be determined"
        tries.append("move the camera sideways, in front of objects at several depths")
        tries.append("give the focal length (--intrinsics given)")
    else:
        why = "no consistent reconstruction was found"
        tries.append("check focal length and lens (--intrinsics refine or find)")
    tries.append("or attach known poses (--trajectory FILE)")
    return CaptureError(
        f"poses could not be found: {why}", where=capture.name, got=got, do="; ".join(tries)
    )
