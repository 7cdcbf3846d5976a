"""Our own layout. A capture that is written and read again is exactly the same.

capture.toml       camera, clock, depth bounds, tracks, exposures, split, what is known, notes
frames/NAME.png    8 or 16 bit, grey or RGB
truth/NAME.png     sharp images at mid-exposure, where known
depth/NAME.png     maps of a depth camera, 16 bit, if there was one
events.h5          see `storage.event_writer`
test_events.h5     likewise, of held-out cameras, if any
truth/depth.npy, truth/flow.npy     of all frames, where known; see `Frames`
trajectory.npz     see `captures.native.trajectory`
points.npy         sparse scene points, if any
notes.npz          notes that are arrays, if any
cache/             the disk cache, see `storage.disk_cache`; delete it when you like

A capture that was just recorded has no poses yet. It is stored with a static camera, and
`poses = "unknown"` in its table `[known]` marks this trajectory as a placeholder.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.native.frames import (
    files_of,
    read_depth,
    read_frames,
    write_depth,
    write_frames,
)
from sharpfield.captures.native.known import known_from_notes, known_table, read_known
from sharpfield.captures.native.trajectory import (
    camera_table,
    read_camera,
    read_trajectory,
    write_trajectory,
)
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.core.frames import Frames
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry.trajectory import count_tracks
from sharpfield.storage.arrays import expect_replaceable, load_array, load_arrays, write_arrays
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import write_events
from sharpfield.storage.toml_tables import Table, read_toml

FORMAT, VERSION = "sharpfield-capture", 1

DESCRIPTION = "capture.toml"
EVENTS, TEST_EVENTS = "events.h5", "test_events.h5"
POINTS = "points.npy"
NOTES = "notes.npz"

NO_SPLIT = Split(np.zeros(0, np.int64), np.zeros(0, np.int64))


def recognise(folder: Path) -> bool:
    """Whether a folder has our own layout."""
    return (folder / DESCRIPTION).is_file()


def write(capture: Capture, folder: Path | str) -> None:
    """Write a capture; the folder appears whole or not at all. An earlier capture is replaced.

    Raises:
        CaptureError: The folder holds something that is not a capture, or the capture holds
            something that the layout cannot store.
    """
    folder = Path(folder)
    expect_replaceable(folder, recognise)
    with replacing_folder(folder) as fresh:
        frames = depth = None
        if capture.frames is not None:
            frames = write_frames(capture.frames, capture.split, fresh)
            if capture.depth is not None:
                depth = write_depth(capture.depth, files_of(capture.frames.names), fresh)
        if capture.events is not None:
            write_events(fresh / EVENTS, capture.events)
        if capture.test_events is not None:
            write_events(fresh / TEST_EVENTS, capture.test_events)
        describe(capture, fresh, frames=frames, depth=depth)


def describe(
    capture: Capture,
    folder: Path,
    *,
    frames: list[dict[str, Any]] | None,
    depth: dict[str, Any] | None = None,
) -> None:
    """Write everything but images and events, which must be in the folder already.

    Args:
        capture: Its images and events are not read.
        folder: Where the description goes.
        frames: The table of each frame, see `captures.native.frames`.
        depth: The table of measured depth, see `captures.native.frames`.
    """
    arrays = {k: note for k, note in capture.notes.items() if isinstance(note, np.ndarray)}
    about: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "name": capture.name,
        "source": capture.source,
        "near": float(capture.near),
        "far": float(capture.far),
        "camera": camera_table(capture.camera),
        "clock": {"origin_us": capture.clock.origin_us, "span_us": capture.clock.span_us},
        "trajectory": write_trajectory(capture.trajectory, folder),
        "known": known_table(capture.known),
        "notes": {
            k: note.item() if isinstance(note, np.generic) else note
            for k, note in capture.notes.items()
            if k not in arrays
        },
    }
    if frames is not None:
        held = capture.needed_frames
        about["frames"] = {"encoding": held.encoding, "each": frames}
        if held.exposure.row_delay_us:
            about["frames"]["row_delay_us"] = float(held.exposure.row_delay_us)
    if depth is not None:
        about["depth"] = depth
    if capture.points is not None:
        np.save(folder / POINTS, capture.points)
    if arrays:
        write_arrays(folder / NOTES, arrays)
    (folder / DESCRIPTION).write_text(tomli_w.dumps(about), encoding="utf-8")


def read(folder: Path) -> Capture:
    """Read a capture.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent, or the poses are unknown.
    """
    return expect_poses(read_unposed(folder), folder)


def expect_poses(capture: Capture, where: object) -> Capture:
    """Return the capture itself if its poses are known.

    Raises:
        CaptureError: They are unknown: the trajectory is a placeholder.
    """
    if capture.known.poses == "unknown":
        raise CaptureError(
            "the poses of the camera are unknown",
            where=where,
            got='`poses = "unknown"` in the table [known]',
            do="find the poses with `sharpfield poses`, or ingest the recording with --poses FILE",
        )
    return capture


def read_unposed(folder: Path, _options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read a capture, whether its poses are known or not.

    Where they are unknown, `known.poses` is "unknown" and the trajectory is a static camera at the
    origin. Likewise `known.intrinsics` is "unknown" where the focal length is only a placeholder
    (the image's width), and `known.bounds` where `near` and `far` are placeholders.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent.
    """
    about = read_toml(folder / DESCRIPTION)
    _expect_version(about)
    about.expect_only(
        *("format", "version", "name", "source", "near", "far", "camera", "clock"),
        *("trajectory", "known", "notes", "frames", "depth", "events"),
    )
    times = about.table("clock")
    clock = Clock(times.whole("origin_us"), times.whole("span_us"))
    camera = read_camera(about.table("camera"))
    frames, split, depth = None, NO_SPLIT, None
    if "frames" in about.values:
        frames, split, files = read_frames(about.table("frames"), folder)
        if "depth" in about.values:
            depth = read_depth(about.table("depth"), files, folder)
    notes = dict(about.table("notes", optional=True).values)
    if (folder / NOTES).exists():
        notes |= load_arrays(folder / NOTES)
    if "known" in about.values:
        known = read_known(about.table("known"))
    else:  # an older capture
        known, notes = known_from_notes(notes)
        if frames is not None and "blur_px" in notes:
            frames = replace(frames, blur_px=np.asarray(notes.pop("blur_px"), np.float64))
    trajectory = read_trajectory(about.table("trajectory"), folder, clock)
    streams = [
        _read_events(about, folder / file, camera, clock) if (folder / file).exists() else None
        for file in (EVENTS, TEST_EVENTS)
    ]
    _expect_tracks(trajectory, frames, streams, where=folder)
    return Capture(
        camera=camera,
        trajectory=trajectory,
        clock=clock,
        near=about.number("near"),
        far=about.number("far"),
        frames=frames,
        events=streams[0],
        test_events=streams[1],
        split=split,
        depth=depth,
        points=load_array(folder / POINTS) if (folder / POINTS).exists() else None,
        name=about.text("name", folder.resolve().name),
        source=about.text("source", "native"),
        known=known,
        notes=notes,
    )


def _read_events(about: Table, path: Path, camera: Camera, clock: Clock) -> EventStream:
    """The events; `[events] unit` is for files made elsewhere, which may not state it."""
    unit = about.table("events", optional=True).text("unit", "")
    with open_events(path, unit=unit or None) as file:
        sized = file if file.size else replace(file, size=camera.size)
        if len(sized):
            sized.expect_overlap(
                (clock.origin_us, clock.origin_us + clock.span_us),
                known="the capture's clock",
                do=f'give the unit in {DESCRIPTION}: [events] unit = "ns"',
            )
        return read_events(sized)


def _expect_tracks(
    trajectory: Trajectory, frames: Frames | None, streams: list[EventStream | None], *, where: Path
) -> None:
    """Check that the tracks of frames and events have poses."""
    known = count_tracks(trajectory)
    used = [] if frames is None else [frames.track]
    used += [one.track for one in streams if one is not None and one.track is not None]
    for track in used:
        if len(track) and not (0 <= track.min() and track.max() < known):
            raise CaptureError(
                "a frame or an event belongs to a track without poses",
                where=where,
                got=f"tracks {track.min()} to {track.max()}, {known} with poses",
                do="add the missing tracks to the trajectory, or correct `track`",
            )


def _expect_version(about: Table) -> None:
    found = about.text("format"), about.whole("version")
    if found != (FORMAT, VERSION):
        raise CaptureError(
            "unknown format of a capture",
            where=about.where,
            got=f"{found[0]} version {found[1]}",
            do=f"this program reads {FORMAT} version {VERSION}",
        )


LAYOUT = Layout("native", recognise, read_unposed, "capture.toml")
