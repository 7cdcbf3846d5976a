"""Videos of event frames of held-out event cameras, recorded beside predicted.

A video shows one window after the other, recorded on the left, predicted on the right, in one
scale. The prediction is the published one: the change of log light over a window in whole
thresholds. (The `events` command renders event streams instead.)

Source: EvDNeRF (WACV 2024), figures and videos of event frames.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Model
from sharpfield.evaluation.event_scores import (
    EVENT_METRICS,
    count_recorded,
    mean_threshold,
    render_log_intensity,
)
from sharpfield.report.colormaps import Rgb, colour_signs, side_by_side
from sharpfield.report.event_frames import full_count
from sharpfield.report.page import TextTable
from sharpfield.report.video import write_video
from sharpfield.storage.event_cache import event_index

CAMERAS = 2
"""Most cameras with a video, evenly spread over those held out."""
WINDOWS = 20
"""Windows of a video; together they cover the capture."""
FPS = 8.0
"""Windows per second of the video."""
HEIGHT_PX = 240
"""Smaller images are enlarged by a whole factor up to this height."""
GAP_PX = 4
"""Gap between the two images."""


def write_event_videos(model: Model, capture: Capture, run: Path) -> list[dict[str, Any]]:
    """Write a video for some held-out event cameras.

    Args:
        model: Trained.
        capture: On the same clock as the model's own; holds event cameras out.
        run: Folder that gets `renders/events/`.

    Returns:
        The number of each camera, and where its video is.
    """
    held_out = capture.test_events
    if held_out is None or not len(held_out):
        return []
    tracks = np.unique(np.asarray(held_out.track)) if held_out.track is not None else np.zeros(1)
    chosen = tracks[np.linspace(0, len(tracks) - 1, min(CAMERAS, len(tracks))).astype(int)]
    found = []
    for track in chosen.astype(int).tolist():
        path = Path("renders") / "events" / f"{track:02d}.mp4"
        (run / path).parent.mkdir(parents=True, exist_ok=True)
        write_video(run / path, _images(model, capture, track), fps=FPS)
        found.append({"track": track, "video": path.as_posix()})
    return found


def events_section(run: Path, metrics: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the page shows of held-out event cameras; None if there are none."""
    events = metrics.get("events")
    if events is None:
        return None
    known = [metric for metric in EVENT_METRICS if metric.name in events["definitions"]]
    rows = tuple(
        (
            f"1/{1 / float(length):.0f} of the capture",
            *(metric.text(scores.get(metric.name)) for metric in known),
        )
        for length, scores in events["lengths"].items()
    )
    return {
        "videos": [
            (one["track"], (run / one["video"]).read_bytes())
            for one in events.get("videos", [])
            if (run / one["video"]).is_file()
        ],
        "table": TextTable(("windows", *(metric.title for metric in known)), rows),
        "definitions": events["definitions"],
    }


def _images(model: Model, capture: Capture, track: int) -> list[Rgb]:
    """Recorded and predicted event frame of each window side by side."""
    assert capture.test_events is not None
    index = event_index(capture.test_events)
    ends = np.linspace(0, 1, WINDOWS + 1)
    log_images = [render_log_intensity(model, track, float(time)) for time in ends]
    predicted = [
        ((after - before) / mean_threshold(capture)).trunc().numpy()
        for before, after in zip(log_images, log_images[1:], strict=False)
    ]
    counts = [
        count_recorded(capture, index, track, (float(a), float(b))).numpy()
        for a, b in zip(ends, ends[1:], strict=False)
    ]
    recorded = [brighter - darker for darker, brighter in counts]
    full = full_count(np.stack(recorded).astype(np.int32))
    return [
        _beside(*(colour_signs(frame, full) for frame in pair))
        for pair in zip(recorded, predicted, strict=True)
    ]


def _beside(left: Rgb, right: Rgb) -> UInt8[np.ndarray, "high wide 3"]:
    """Two images side by side, enlarged."""
    factor = max(HEIGHT_PX // left.shape[0], 1)
    left, right = (np.kron(one, np.ones((factor, factor, 1), np.uint8)) for one in (left, right))
    return side_by_side(left, right, gap_px=GAP_PX, grey=128)
