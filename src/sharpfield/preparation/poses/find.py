"""Find the poses of a capture from its own frames, sharpened by its events where there are any.

    sharp images  ->  map of points and poses  ->  a world of its own  ->  a path through time

Frames whose pose was not found but that lie between others stay in the capture, on the path, and
are neither learned from nor held out; frames beyond the path's ends are left out, and so are
events beyond them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64

from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.geometry.space import Similarity
from sharpfield.geometry.trajectory import Stamped, Still, Tracks
from sharpfield.preparation.options import PoseOptions
from sharpfield.preparation.poses.find_checks import Relief, relief
from sharpfield.preparation.poses.images import Sharp, Source, sharp_images
from sharpfield.preparation.poses.mapping import (
    LEAST_FEATURES,
    LEAST_MATCHES,
    Intrinsics,
    LensTask,
    Map,
    Seen,
    map_images,
)
from sharpfield.preparation.poses.path import Laid, path_through
from sharpfield.preparation.poses.world import Known, depths, known_world, measured_world, own_world

INSTANTS, MOST_IMAGES = 3, 120
"""Images taken from each exposure, as long as there are not more in all."""

LEAST_SHARE = 0.5
"""Share of the images that must be found for the result to be worth writing."""

FLAT = 0.9
"""Share of pairs explained by a plane, from which on the scene or the motion is said to be flat."""

ERROR_PX, VIEWS = 1.5, 3
"""A point of the cloud is seen no farther than this from where it projects, in so many images."""

BOUNDS_PERCENT = (0.5, 99.5)
BOUNDS_MARGIN = 1.1
"""Near and far are these percentiles of the depth of all observations, and a margin."""


KnownAt = Callable[[Int64[np.ndarray, "n"]], Known]
"""Gives the poses that something else says for some times of the capture, in us."""


@dataclass(frozen=True)
class Failure:
    """A image without a pose."""

    image: int
    why: str
    do: str


@dataclass(frozen=True)
class PosesFound:
    """A capture with poses, and how they were come by."""

    capture: Capture
    sharp: Sharp
    map: Map
    """In the world of the capture."""
    seen: Seen
    failures: tuple[Failure, ...]
    kept: Int64[np.ndarray, "m"]
    """Which frames of the original capture are in the new one."""
    intrinsics: Intrinsics
    relief: Relief | None
    """How much depth the images show; None if they share too little to say."""
    off_known: float | None = None
    """Root mean square distance of camera centres from known ones."""


def find_poses(
    capture: Capture, options: PoseOptions, *, known: KnownAt | None = None
) -> PosesFound:
    """The capture with poses, points, depth bounds and, if they were unknown, intrinsics.

    Args:
        capture: With frames. Poses it has are not looked at.
        options: Images, lens.
        known: Says poses at some times of the capture, and thereby what the world is.

    Raises:
        CaptureError: Poses could not be found; the message says why and what to try.
        MissingExtra: pycolmap is not installed.
    """
    sharp = sharp_images(
        capture, options.images, instants=options.instants or _instants(capture, options.images)
    )
    intrinsics = options.intrinsics or _usual(capture)
    task = LensTask(capture.camera, intrinsics, options.lens)
    found, seen = map_images(sharp.images, task, seed=options.seed)
    if found is None or found.registered.sum() < max(3, LEAST_SHARE * len(sharp)):
        raise _hopeless(capture, sharp, found, seen)
    off = None
    if known is not None:
        change, off = known_world(found, known(sharp.time_us))
    elif capture.depth is not None:
        change = measured_world(found, capture, sharp.frame)
    else:
        change = own_world(found)
    found = _moved(found, change)
    made, laid = _with_poses(capture, sharp, found, intrinsics)
    failures = tuple(
        Failure(int(i), *_why(int(i), sharp, seen)) for i in np.flatnonzero(~found.registered)
    )
    return PosesFound(made, sharp, found, seen, failures, laid.kept, intrinsics, relief(found), off)


def within(events: EventStream, path: Stamped | Still | Tracks, laid: Laid) -> EventStream:
    """Events of tracks and times that the path knows, their tracks numbered anew."""
    if events.track is not None:
        track = laid.track_of[np.asarray(events.track, np.int64)]
        there = np.flatnonzero(track >= 0)
        events = replace(
            events,
            x=events.x[there],
            y=events.y[there],
            t_us=events.t_us[there],
            p=events.p[there],
            track=track[there].astype(np.uint16),
            tracks=int(laid.track_of.max()) + 1,
        )
    spans = [span for t in range(events.tracks) if (span := path.known_us(t)) is not None]
    if not spans:
        return events
    return events.window(min(s[0] for s in spans), max(s[1] for s in spans) + 1)


def _instants(capture: Capture, source: Source) -> int:
    """Images to take from each exposure: the motion during long ones is no straight line."""
    blurred = int((~capture.needed_frames.exposure.instant).sum())
    if capture.events is None or not blurred or source not in ("auto", "edi"):
        return 1
    return max(min(INSTANTS, MOST_IMAGES // blurred), 1)


def _usual(capture: Capture) -> Intrinsics:
    return "find" if capture.known.intrinsics == "unknown" else "given"


def _moved(found: Map, change: Similarity) -> Map:
    poses = found.poses.copy()
    poses[found.registered] = change.poses(found.poses[found.registered])
    return replace(found, poses=poses, points=change.points(found.points))


def _with_poses(
    capture: Capture, sharp: Sharp, found: Map, intrinsics: Intrinsics
) -> tuple[Capture, Laid]:
    there = found.registered
    laid = path_through(
        capture.needed_frames, sharp.frame[there], sharp.time_us[there], found.poses[there],
        capture.clock,
    )  # fmt: skip
    good = (found.point_error_px < ERROR_PX) & (found.track_length >= VIEWS)
    good = good if good.any() else np.ones_like(good)
    near, far = np.percentile(depths(found)[good[found.observations[:, 1]]], BOUNDS_PERCENT)
    unsure = np.setdiff1d(np.arange(len(capture.needed_frames)), sharp.frame[there])
    streams = {
        name: None if (held := getattr(capture, name)) is None else within(held, laid.path, laid)
        for name in ("events", "test_events")
    }
    made = replace(
        capture,
        camera=found.camera,
        trajectory=laid.path,
        near=float(near) / BOUNDS_MARGIN,
        far=float(far) * BOUNDS_MARGIN,
        frames=laid.frames,
        split=split_of(capture.split, laid.kept, unsure),
        points=found.points[good],
        depth=None
        if capture.depth is None
        else replace(capture.depth, stored=capture.depth.stored[laid.kept]),
        known=replace(capture.known, poses="known", intrinsics="known", bounds="known"),
        notes=capture.notes
        | {"poses_from": f"structure from motion, {sharp.source}, {intrinsics} lens"},
        **streams,
    )
    return made, laid


def split_of(split: Split, kept: Int64[np.ndarray, "m"], unsure: Int64[np.ndarray, "u"]) -> Split:
    """What is left of a split, by the new indices."""
    sure = ~np.isin(kept, unsure)
    return Split(
        train=np.flatnonzero(sure & np.isin(kept, split.train)),
        test=np.flatnonzero(sure & np.isin(kept, split.test)),
    )


def _why(image: int, sharp: Sharp, seen: Seen) -> tuple[str, str]:
    """Why a image has no pose, and what to try."""
    features, matches = int(seen.features[image]), int(seen.matches[image])
    if features < LEAST_FEATURES:
        why = f"only {features} features: it is dark, blurred or has little texture"
        do = (
            "use the events: --images edi"
            if sharp.source != "edi"
            else "check the thresholds with `sharpfield calibrate`, or leave the frame out"
        )
        return why, do
    if matches < LEAST_MATCHES:
        return (
            f"{features} features, but no other image shows the same",
            "take images closer together, --instants 3, or leave the frame out",
        )
    return (
        f"{matches} matches, but too few of them are points of the map",
        "take more images around it, or --instants 3",
    )


def _hopeless(capture: Capture, sharp: Sharp, found: Map | None, seen: Seen) -> CaptureError:
    """What to say when nothing, or too little, could be mapped."""
    count = 0 if found is None else int(found.registered.sum())
    features, matches = np.median(seen.features), np.median(seen.matches)
    got = (
        f"{count} of {len(sharp)} images found; the median image has {features:.0f} features"
        f" and {matches:.0f} matches"
    )
    tries = []
    if sharp.source != "edi" and capture.events is not None:
        tries.append("deblur with the events first (--images edi)")
    if features < LEAST_FEATURES:
        why = "the images have too few features: dark, blurred or without texture"
        tries.append("light the scene, shorten the exposure, or put texture into view")
    elif matches < LEAST_MATCHES:
        why = "the images have too little in common"
        tries.append("take them closer together, or several per exposure (--instants 3)")
    elif seen.flat_pairs > FLAT:
        why = "a plane, or turning on the spot, explains all matches, so depth stays open"
        tries.append("move the camera sideways, before things at several depths")
        tries.append("give the focal length (--intrinsics given)")
    else:
        why = "no consistent map of points came out"
        tries.append("check focal length and lens (--intrinsics refine or find)")
    tries.append("or attach poses from elsewhere (--trajectory FILE)")
    return CaptureError(
        f"poses could not be found: {why}", where=capture.name, got=got, do="; ".join(tries)
    )
