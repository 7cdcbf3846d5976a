"""Summary of a capture or of a file of events, as plain values ready for JSON.

A file is read a chunk at a time, so it need not fit in memory. Where a file does not state the unit
of its times, times in us and rates are None and the first and last stored times are given instead.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sharpfield.captures.layout import NO_OPTIONS, ReadOptions
from sharpfield.captures.layouts import llff_events
from sharpfield.captures.native.known import known_table
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture
from sharpfield.core.events import EventStream
from sharpfield.core.frames import DepthMaps, Frames
from sharpfield.geometry.trajectory import count_tracks
from sharpfield.storage.event_columns import polarity
from sharpfield.storage.event_file import CHUNK, EventFile
from sharpfield.storage.event_layouts import open_events

DEPTH_SAMPLES = 16
"""Depth maps from which the share of known pixels and the median are computed."""

PATH_SAMPLES = 1000
"""Number of poses from which the length of a trajectory is computed."""

EVENT_SUFFIXES = (".h5", ".hdf5", ".npz")


def path_summary(path: Path | str, options: ReadOptions = NO_OPTIONS) -> dict[str, Any]:
    """Summary of a capture's folder, or of a single file of events.

    Args:
        path: The folder or file.
        options: How to read it; of a single file of events, `event_unit`.

    Raises:
        CaptureError: It cannot be read.
    """
    path = Path(path)
    if path.is_file() and path.suffix in EVENT_SUFFIXES:
        with open_events(path, unit=options.event_unit) as file:
            known = file if file.unit else replace(file, unit=_unit_of_layout(path))
            return {"kind": "events", "name": path.name, "events": file_summary(known)}
    capture = read_capture(path, options, poses=False)
    return capture_summary(capture)


def capture_summary(capture: Capture) -> dict[str, Any]:
    """Summary of a capture."""
    about: dict[str, Any] = {"kind": "capture", "name": capture.name, "layout": capture.source}
    if capture.events is not None:
        about["events"] = stream_summary(capture.events)
    if capture.test_events is not None:
        about["test_events"] = stream_summary(capture.test_events)
    if capture.frames is not None:
        about["frames"] = _frames_summary(capture.frames)
        if capture.known.motion == "unknown":  # exposures do not tell blurry from sharp
            about["frames"] |= {"blurry": None, "sharp": None}
        about["split"] = {
            "train": len(capture.split.train),
            "test": len(capture.split.test),
            "test_frames": [capture.frames.names[i] for i in capture.split.test],
        }
    camera = capture.camera
    about["camera"] = {
        "width": camera.width,
        "height": camera.height,
        "focal_px": [camera.fx_px, camera.fy_px],
        "centre_px": [camera.cx_px, camera.cy_px],
        "lens": camera.lens,
    }
    about["trajectory"] = _trajectory_summary(capture)
    about["bounds"] = {"near": capture.near, "far": capture.far}
    about["clock"] = {"origin_us": capture.clock.origin_us, "span_us": capture.clock.span_us}
    if capture.depth is not None:
        about["depth"] = _depth_summary(capture.depth)
    about["points"] = 0 if capture.points is None else len(capture.points)
    about["known"] = known_table(capture.known)
    about["notes"] = {
        key: f"array {note.shape}" if isinstance(note, np.ndarray) else note
        for key, note in capture.notes.items()
    }
    return about


def stream_summary(events: EventStream) -> dict[str, Any]:
    """Summary of a stream of events."""
    positive = sum(
        int((events.p[first : first + CHUNK] > 0).sum()) for first in range(0, len(events), CHUNK)
    )
    span = (int(events.t_us[0]), int(events.t_us[-1])) if len(events) else None
    return {
        **_counts(len(events), positive, span),
        "width": events.width,
        "height": events.height,
        "rectified": events.rectified,
        "coloured": events.coloured,
        **_tracks_summary(events),
    }


def _tracks_summary(events: EventStream) -> dict[str, Any]:
    """Number of events of each camera, where there are several."""
    if events.track is None:
        return {}
    each = np.bincount(events.track, minlength=events.tracks)
    return {"tracks": events.tracks, "count_by_track": each.tolist()}


def file_summary(file: EventFile) -> dict[str, Any]:
    """Summary of a file of events; all of it is read and checked, a chunk at a time.

    Raises:
        CaptureError: A part cannot be read, or the events are invalid.
    """
    positive, largest = 0, [-1.0, -1.0]
    for first in range(0, len(file), CHUNK):
        last = min(first + CHUNK, len(file))
        positive += int((polarity(file.stored("p", first, last), file.path) > 0).sum())
        for i, name in enumerate(("x", "y")):
            largest[i] = max(largest[i], float(file.stored(name, first, last).max()))
    span = file.span_us() if file.unit is not None and len(file) else None
    # Without a stated resolution the largest coordinates are a lower bound.
    width, height = file.size or (max(int(x) + 1, 1) for x in largest)
    replace(file, size=(width, height), unit=file.unit or "us").check()  # in any unit
    about = {
        **_counts(len(file), positive, span),
        "width": width,
        "height": height,
        "size_from": "file" if file.size else "largest coordinates",
        "unit": file.unit,
    }
    if file.unit is None and len(file):
        ends = [file.stored("t", i, i + 1)[0].item() for i in (0, len(file) - 1)]
        about |= {"t_first": ends[0], "t_last": ends[1]}
    return about


def _unit_of_layout(path: Path) -> str | None:
    """The unit of event times of an Ev-DeblurNeRF capture, if the file belongs to one."""
    folder = path.parent
    if not (llff_events.recognise(folder) and path.name == "events.h5"):
        return None
    return llff_events.variant_of(folder).event_unit


def _counts(count: int, positive: int, span_us: tuple[int, int] | None) -> dict[str, Any]:
    first, last = span_us or (None, None)
    seconds = (span_us[1] - span_us[0]) / 1e6 if span_us else 0.0
    return {
        "count": count,
        "on": positive,
        "off": count - positive,
        "t_first_us": first,
        "t_last_us": last,
        "duration_s": seconds if span_us else None,
        "rate_per_s": count / seconds if seconds > 0 else None,
    }


def _frames_summary(frames: Frames) -> dict[str, Any]:
    sharp = int(frames.exposure.instant.sum())
    duration = frames.exposure.duration_us[~frames.exposure.instant]
    return {
        "count": len(frames),
        "blurry": len(frames) - sharp,
        "sharp": sharp,
        "width": frames.width,
        "height": frames.height,
        "channels": frames.channels,
        "bits": 8 * frames.images.dtype.itemsize,
        "encoding": frames.encoding,
        "t_first_us": int(frames.exposure.open_us.min()),
        "t_last_us": int(frames.exposure.close_us.max()),
        "exposure_us": {
            "least": int(duration.min()),
            "median": int(np.median(duration)),
            "most": int(duration.max()),
        }
        if len(duration)
        else None,
        "with_truth": int(frames.with_truth.sum()),
        "with_depth": frames.depth is not None,
        "with_flow": frames.flow is not None,
    }


def _depth_summary(depth: DepthMaps) -> dict[str, Any]:
    """Size, share of known pixels and median depth, from a few of the maps."""
    some = np.linspace(0, len(depth) - 1, min(len(depth), DEPTH_SAMPLES)).astype(int)
    measured = np.stack([depth.at(int(frame)) for frame in some])
    known = measured[measured > 0]
    return {
        "count": len(depth),
        "width": depth.camera.width,
        "height": depth.camera.height,
        "unit": depth.unit,
        "known_share": len(known) / measured.size,
        "median": float(np.median(known)) if len(known) else None,
    }


def _trajectory_summary(capture: Capture) -> dict[str, Any]:
    """Number of tracks, and the time span and path length of the first."""
    tracks = count_tracks(capture.trajectory)
    about: dict[str, Any] = {"kind": type(capture.trajectory).__name__, "tracks": tracks}
    known = capture.trajectory.known_us(0)
    if known is None:
        return about
    first, last = capture.clock.unit(np.array(known)).tolist()
    instants = torch.linspace(first, last, PATH_SAMPLES)
    centres = capture.trajectory.pose(instants, torch.zeros(PATH_SAMPLES).long())[:, :, 3]
    length = float(centres.diff(dim=0).norm(dim=-1).sum())
    return about | {"t_first_us": known[0], "t_last_us": known[1], "path_length": length}
