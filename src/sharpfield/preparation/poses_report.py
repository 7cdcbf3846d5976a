"""What finding poses leaves behind in numbers and words: which pictures, how well, and why not."""

from typing import Any

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.preparation.poses_find import PosesFound
from sharpfield.preparation.poses_relief import advice


def summary(original: Capture, found: PosesFound) -> dict[str, Any]:
    """Plain values, ready for JSON.

    Lengths are in units of the new world. Errors are distances, in px, between where points were
    seen and where they project.
    """
    made, sharp, mapped = found.capture, found.sharp, found.map
    there = mapped.registered
    camera = made.camera
    known = None if sharp.found is None else sharp.found.thresholds
    names = original.needed_frames.names
    return {
        "capture": original.name,
        "pictures_from": sharp.source,
        "thresholds": None
        if known is None
        else {"negative": known.negative, "positive": known.positive},
        "pictures": len(sharp),
        "registered": int(there.sum()),
        "frames": {
            "before": len(original.needed_frames),
            "after": len(made.needed_frames),
            "train": len(made.split.train),
            "test": len(made.split.test),
            "left_out": [names[i] for i in range(len(names)) if i not in found.kept],
        },
        "error_px": _rounded(float(np.nanmean(mapped.error_px)), 3),
        "points": {
            "map": len(mapped.points),
            "kept": 0 if made.points is None else len(made.points),
            "mean_track_length": _rounded(mapped.track_length.mean(), 2),
            "median_error_px": _rounded(np.median(mapped.point_error_px), 3),
        },
        "camera": {
            "from": found.intrinsics,
            "lens": camera.lens,
            "focal_px": [_rounded(camera.fx_px, 2), _rounded(camera.fy_px, 2)],
            "centre_px": [_rounded(camera.cx_px, 2), _rounded(camera.cy_px, 2)],
            "distortion": list(camera.distortion),
        },
        "bounds": {"near": _rounded(made.near, 4), "far": _rounded(made.far, 4)},
        "off_known_positions": found.off_known,
        "relief": _relief(found),
        "each": _each(original, found),
    }


def as_text(about: dict[str, Any]) -> str:
    """The summary in lines for a terminal; every picture that failed says why and what to do."""
    frames, points, camera = about["frames"], about["points"], about["camera"]
    lines = [
        f"{about['registered']} of {about['pictures']} pictures have a pose"
        f" (taken from {about['pictures_from']}), {about['error_px']} px off on average",
        f"{points['map']} points, each seen in {points['mean_track_length']} pictures",
        f"focal length {camera['focal_px'][0]} px ({camera['from']}), depth"
        f" {about['bounds']['near']} to {about['bounds']['far']}",
        f"{frames['after']} of {frames['before']} frames are in the new capture:"
        f" {frames['train']} to train, {frames['test']} held out",
    ]
    if about["off_known_positions"] is not None:
        lines.append(f"camera centres are {about['off_known_positions']:.4g} from the known ones")
    if about["relief"] is not None and about["relief"]["flat"]:
        lines.append(f"warning: {about['relief']['why']}")
        lines.append(f"  do     {about['relief']['do']}")
    failed = [one for one in about["each"] if not one["registered"]]
    for one in failed:
        lines.append(f"no pose: {one['frame']} at {one['time_us']} us: {one['why']}")
        lines.append(f"  do     {one['do']}")
    return "\n".join(lines)


def _relief(found: PosesFound) -> dict[str, Any] | None:
    shown = found.relief
    if shown is None:
        return None
    told = advice(shown, found.intrinsics)
    return {
        "flat": shown.flat,
        "off_plane": _rounded(shown.off_plane, 4),
        "tolerance_px": _rounded(shown.tolerance_px, 3),
        "thickness": _rounded(shown.thickness, 4),
        "pairs": shown.pairs,
    } | ({} if told is None else {"why": told[0], "do": told[1]})


def _each(original: Capture, found: PosesFound) -> list[dict[str, Any]]:
    sharp, mapped, seen = found.sharp, found.map, found.seen
    points = np.bincount(mapped.sightings[:, 0], minlength=len(sharp))
    failures = {failure.picture: failure for failure in found.failures}
    rows = []
    for i in range(len(sharp)):
        row: dict[str, Any] = {
            "frame": original.needed_frames.names[sharp.frame[i]],
            "time_us": int(sharp.time_us[i]),
            "registered": bool(mapped.registered[i]),
            "features": int(seen.features[i]),
            "matches": int(seen.matches[i]),
            "partners": int(seen.partners[i]),
            "points": int(points[i]),
            "error_px": _rounded(mapped.error_px[i], 3) if mapped.registered[i] else None,
        }
        if i in failures:
            row |= {"why": failures[i].why, "do": failures[i].do}
        rows.append(row)
    return rows


def _rounded(value: float, digits: int) -> float:
    return round(float(value), digits)
