"""Reports of pose finding: `poses.json`, text for the terminal, and the page `poses.html`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.preparation.poses.find import PosesFound, advice
from sharpfield.report.colormaps import stored_as_bytes
from sharpfield.report.figures import trajectory_figure
from sharpfield.report.page import (
    CaptionedImage,
    ComparedView,
    ImageEncoding,
    TextTable,
    write_page,
)


def poses_summary(original: Capture, found: PosesFound) -> dict[str, Any]:
    """Plain values for JSON.

    Lengths are in units of the new world. Errors are reprojection errors in px.
    """
    made, images, mapped = found.capture, found.images, found.map
    there = mapped.registered
    camera = made.camera
    known = None if images.found is None else asdict(images.found.thresholds)
    names, errors = original.needed_frames.names, found.errors
    return {
        "capture": original.name,
        "images_from": images.source,
        "thresholds": known,
        "images": len(images),
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
        "off_known_positions": None if errors is None else errors.absolute.translation,
        "pose_errors": None if errors is None else asdict(errors),
        "relief": _relief(found),
        "each": _each(original, found),
    }


def poses_text(about: dict[str, Any]) -> str:
    """The summary as text for the terminal; each failed image with its reason and what to do."""
    frames, points, camera = about["frames"], about["points"], about["camera"]
    lines = [
        f"{about['registered']} of {about['images']} images have a pose"
        f" (taken from {about['images_from']}), {about['error_px']} px mean reprojection error",
        f"{points['map']} points, each observed in {points['mean_track_length']} images",
        f"focal length {camera['focal_px'][0]} px ({camera['from']}), depth"
        f" {about['bounds']['near']} to {about['bounds']['far']}",
        f"{frames['after']} of {frames['before']} frames are in the new capture:"
        f" {frames['train']} to train, {frames['test']} held out",
    ]
    if about["off_known_positions"] is not None:
        lines.append(
            f"camera centres differ by {about['off_known_positions']:.4g} (RMS) from the known ones"
        )
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
    warning = advice(shown, found.intrinsics)
    return {
        "flat": shown.flat,
        "off_plane": _rounded(shown.off_plane, 4),
        "tolerance_px": _rounded(shown.tolerance_px, 3),
        "thickness": _rounded(shown.thickness, 4),
        "pairs": shown.pairs,
    } | ({} if warning is None else {"why": warning[0], "do": warning[1]})


def _each(original: Capture, found: PosesFound) -> list[dict[str, Any]]:
    images, mapped, counts = found.images, found.map, found.counts
    points = np.bincount(mapped.observations[:, 0], minlength=len(images))
    failures = {failure.image: failure for failure in found.failures}
    rows = []
    for i in range(len(images)):
        row: dict[str, Any] = {
            "frame": original.needed_frames.names[images.frame[i]],
            "time_us": int(images.time_us[i]),
            "registered": bool(mapped.registered[i]),
            "features": int(counts.features[i]),
            "matches": int(counts.matches[i]),
            "partners": int(counts.partners[i]),
            "points": int(points[i]),
            "error_px": _rounded(mapped.error_px[i], 3) if mapped.registered[i] else None,
        }
        if i in failures:
            row |= {"why": failures[i].why, "do": failures[i].do}
        rows.append(row)
    return rows


def _rounded(value: float, digits: int) -> float:
    return round(float(value), digits)


ENCODING = ImageEncoding(640, 82)
SHOWN = 6
"""Registered images shown, and failed ones."""
GREEN, AMBER = (40, 200, 90), (245, 160, 40)
ENLARGE, SMALL_PX = 2, 480
"""Images smaller than this are enlarged, so that marks in them can be told apart."""

IMAGE_SOURCES = {
    "edi": "frames deblurred with their events",
    "frames": "frames as recorded",
    "sharpest": "the sharpest of each three frames",
}


def write_poses_page(
    path: Path, original: Capture, found: PosesFound, about: dict[str, Any]
) -> None:
    """Write the page; `about` is the summary of what was found for the original capture."""
    relief = about["relief"]
    flat = None
    if relief is not None and relief["flat"]:
        flat = TextTable(("what is unsure", "what to try"), ((relief["why"], relief["do"]),))
    failed = np.flatnonzero(~found.map.registered)[:SHOWN]
    registered = evenly_spread(np.flatnonzero(found.map.registered), SHOWN)
    values = {
        "title": f"{about['capture']}: poses",
        "heading": about["capture"],
        "subtitle": f"From {IMAGE_SOURCES[about['images_from']]}",
        "cards": _cards(about),
        "flat": flat,
        "failures": _failures(about),
        "views": [_view(original, found, int(i)) for i in [*failed, *registered]],
        "trajectory": trajectory_figure(found.capture),
        "images": _images(about),
        "encoding": ENCODING,
    }
    write_page(path, "poses.html.j2", values)


def _cards(about: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Value, name and remark of the most important numbers."""
    points, camera, bounds = about["points"], about["camera"], about["bounds"]
    length_unit = (
        "median depth of the points is 1"
        if about["off_known_positions"] is None
        else "in units of the known positions"
    )
    return [
        (f"{about['registered']} of {about['images']}", "images with a pose", "registered"),
        (f"{about['error_px']:.2f} px", "reprojection error", "mean over images"),
        (f"{points['map']:,}", "points", f"each seen in {points['mean_track_length']:.1f} images"),
        (f"{camera['focal_px'][0]:.1f} px", "focal length", str(camera["from"])),
        (f"{bounds['near']:.3g} … {bounds['far']:.3g}", "near and far", length_unit),
    ]


def _failures(about: dict[str, Any]) -> TextTable | None:
    rows = tuple(
        (one["frame"], str(one["features"]), str(one["matches"]), one["why"], one["do"])
        for one in about["each"]
        if not one["registered"]
    )
    columns = ("image", "features", "matches", "why it has no pose", "what to try")
    return TextTable(columns, rows) if rows else None


def _images(about: dict[str, Any]) -> TextTable:
    rows = tuple(
        (
            one["frame"],
            f"{one['time_us'] / 1000:.1f}",
            str(one["features"]),
            str(one["partners"]),
            str(one["points"]),
            "–" if one["error_px"] is None else f"{one['error_px']:.2f}",
        )
        for one in about["each"]
    )
    return TextTable(("frame", "time, ms", "features", "partners", "points", "error, px"), rows)


def _view(original: Capture, found: PosesFound, image: int) -> ComparedView:
    frames, frame = original.needed_frames, int(found.images.frame[image])
    name = frames.names[frame]
    recorded = _enlarged(stored_as_bytes(frames.images[frame]))
    caption = (
        f"{name}, used: {found.map.error_px[image]:.2f} px"
        if found.map.registered[image]
        else f"{name}: no pose"
    )
    return ComparedView(
        f"{name} ({image})",
        (
            CaptionedImage("recorded", recorded, name, f"{name} as recorded"),
            CaptionedImage("used", _marked(found, image), caption, f"{name} with its points"),
        ),
    )


def _marked(found: PosesFound, image: int) -> UInt8[np.ndarray, "h w 3"]:
    """The image with the points of the map projected into it."""
    shown = np.ascontiguousarray(_enlarged(found.images.images[image]))
    if not found.map.registered[image]:
        return shown
    rows = found.map.observations[found.map.observations[:, 0] == image, 1]
    pose = found.map.poses[image]
    local = (found.map.points[rows] - pose[:, 3]) @ pose[:, :3]  # [m, 3], camera axes
    xy = found.map.camera.project(torch.from_numpy(local)).numpy() * (
        shown.shape[1] / found.map.camera.width
    )
    for (x, y), error in zip(xy, found.map.point_error_px[rows], strict=True):
        colour = GREEN if error < 1 else AMBER
        cv2.circle(shown, (round(x), round(y)), 3, colour, 1, cv2.LINE_AA)
    return shown


def _enlarged(image: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w 3"]:
    """In three channels, and large enough to see marks in it."""
    colour = np.repeat(image, 3, -1) if image.shape[-1] == 1 else image
    if max(colour.shape) >= SMALL_PX:
        return colour
    return cv2.resize(colour, None, fx=ENLARGE, fy=ENLARGE, interpolation=cv2.INTER_CUBIC)
