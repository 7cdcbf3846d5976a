"""Find the poses of a capture from its frames, deblurred by its events where there are any.

    sharp images  ->  map of points and poses  ->  world coordinates  ->  trajectory over time

Frames without a pose between others stay in the capture, on the trajectory, but are neither trained
on nor held out. Frames and events before the start or after the end of the trajectory are left out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.geometry.space import Similarity
from sharpfield.preparation.options import ImageSource, PoseOptions
from sharpfield.preparation.poses.find_checks import Relief, relief
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
    KnownPoses,
    PoseErrors,
    capture_on_path,
    centred_world,
    depths,
    known_world,
    measured_world,
    path_through,
)

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


KnownAt = Callable[[Int64[np.ndarray, "n"]], KnownPoses]
"""Gives known poses at some times of the capture, in us."""


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
    intrinsics = options.intrinsics or _default_intrinsics(capture)
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
    found = _transformed(found, change)
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


def _default_intrinsics(capture: Capture) -> Intrinsics:
    return "find" if capture.known.intrinsics == "unknown" else "given"


def _transformed(found: SfmMap, change: Similarity) -> SfmMap:
    poses = found.poses.copy()
    poses[found.registered] = change.poses(found.poses[found.registered])
    return replace(found, poses=poses, points=change.points(found.points))


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
