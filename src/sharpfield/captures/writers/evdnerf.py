"""Write a capture in the layout of EvDNeRF's data, see `layouts.evdnerf`.

Training views are the training set, the others the validation set. The layout cannot store moving
cameras, exposures that last, or lens distortion; a capture with these is refused. Its clock lasts
one second: times count from the first frame, and are scaled if the last one is not a second later.
Events outside are left out, and so are depth, flow and notes.

Raw streams are written as plain arrays (`data_train.npz`), which are safe to read; the published
ones are pickled.
"""

import json
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from sharpfield.captures.layouts._transforms import OPENCV_FROM_OPENGL
from sharpfield.captures.layouts.evdnerf import recognise
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing_folder
from sharpfield.events.image import window_image
from sharpfield.events.index import build_index
from sharpfield.geometry.trajectory import Still
from sharpfield.storage.arrays import expect_replaceable
from sharpfield.storage.event_layouts import THRESHOLDS
from sharpfield.storage.images import write_image

SECOND_NS = 1_000_000_000


def write(capture: Capture, folder: Path | str) -> None:
    """Write images, events and poses; the folder appears whole or not at all.

    Raises:
        CaptureError: The folder holds something that is not a capture, or the layout cannot store
            something essential.
    """
    folder = Path(folder)
    expect_replaceable(folder, recognise)
    _expect_expressible(capture)
    frames = capture.needed_frames
    train = np.unique(frames.track[capture.split.train])
    sets = {
        "train": (train, capture.needed_events),
        "val": (np.setdiff1d(np.unique(frames.track), train), capture.test_events),
    }
    with replacing_folder(folder) as fresh:
        for name, (tracks, events) in sets.items():
            if len(tracks):
                _write_views(fresh, name, capture, tracks)
                if events is not None:
                    _write_events(fresh, name, capture, events, tracks)


def _write_views(folder: Path, name: str, capture: Capture, tracks: Int64[np.ndarray, "v"]) -> None:
    """Write images, and the JSON of their times and poses."""
    frames, camera = capture.needed_frames, capture.camera
    assert isinstance(capture.trajectory, Still), "checked before"
    times = _times_us(capture)
    listed = []
    for track in tracks:
        pose = capture.trajectory.poses[track] * OPENCV_FROM_OPENGL
        for i in _frames_of(capture, int(track)):
            file = f"{name}/rgba_{len(listed):05d}"
            image = frames.images[i]
            rgb = image if image.shape[2] == 3 else np.repeat(image, 3, 2)
            opaque = np.full_like(rgb[..., :1], frames.white)
            write_image(folder / f"{file}.png", np.concatenate([rgb, opaque], 2))
            since = int(frames.exposure.open_us[i] - times[0])
            listed.append(
                {
                    "file_path": file,
                    "time": since / int(times[-1] - times[0]),
                    "rotation": math.pi / 10,  # a constant of the published files, unused
                    "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
                }
            )
    about = {
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.fx_px),
        "focal": camera.fx_px,
        **dict(zip(THRESHOLDS, _thresholds(capture), strict=True)),
        "frames": listed,
    }
    (folder / f"transforms_{name}.json").write_text(json.dumps(about, indent=1) + "\n")


def _write_events(
    folder: Path, name: str, capture: Capture, events: EventStream, tracks: Int64[np.ndarray, "v"]
) -> None:
    """Write sums over the windows between frames, and raw streams."""
    times = _times_us(capture)
    within = events.window(int(times[0]), int(times[-1]))
    np.save(folder / f"data_frames_{name}.npy", _sums(capture, within, tracks))
    raw = {}
    for k, track in enumerate(tracks):
        mine = within.of_track(int(track))
        t_ns = (mine.t_us - times[0]) * SECOND_NS // (times[-1] - times[0])
        raw[f"{k:04d}"] = np.stack([t_ns, mine.x, mine.y, mine.p], -1).astype(np.int64)
    np.savez_compressed(folder / f"data_{name}.npz", **raw)


def _sums(
    capture: Capture, events: EventStream, tracks: Int64[np.ndarray, "v"]
) -> Float32[np.ndarray, "v k h w"]:
    """Signed sums of thresholds in each window of each view."""
    index, times = build_index(events), _times_us(capture).tolist()
    off, on = _thresholds(capture)
    size = {"width": events.width, "height": events.height}
    sums = np.empty((len(tracks), len(times) - 1, events.height, events.width), np.float32)
    for view, track in zip(sums, tracks.tolist(), strict=True):
        for window, start, end in zip(view, times[:-1], times[1:], strict=True):
            counts = window_image(index, start, end, track=track, **size)
            window[:] = on * counts[..., 1] - off * counts[..., 0]
    return sums


def _thresholds(capture: Capture) -> tuple[float, float]:
    """Negative and positive."""
    known = capture.known.thresholds
    assert known is not None, "checked before"
    return known.negative, known.positive


def _frames_of(capture: Capture, track: int) -> Int64[np.ndarray, "t"]:
    """The frames of a view, in the order of time."""
    frames = capture.needed_frames
    mine = np.flatnonzero(frames.track == track)
    return mine[np.argsort(frames.exposure.open_us[mine], kind="stable")]


def _times_us(capture: Capture) -> Int64[np.ndarray, "t"]:
    """Times of the frames, the same in every view."""
    return np.unique(capture.needed_frames.exposure.open_us)


def _expect_expressible(capture: Capture) -> None:
    """Check that the layout can store what matters."""
    frames, camera = capture.needed_frames, capture.camera
    centred = (camera.cx_px, camera.cy_px) == (camera.width / 2, camera.height / 2)
    times = _times_us(capture)
    alike = all(
        np.array_equal(frames.exposure.open_us[_frames_of(capture, int(track))], times)
        for track in np.unique(frames.track)
    )
    streams = [one for one in (capture.events, capture.test_events) if one is not None]
    problems = {
        "cameras that move": not isinstance(capture.trajectory, Still),
        "exposures that last": not frames.exposure.instant.all(),
        "views whose frames were taken at different times": not alike or len(times) < 2,
        "a lens, or a principal point off the centre": camera.lens != "pinhole" or not centred,
        "pixels that are not square": camera.fx_px != camera.fy_px,
        "images of 16 bits": frames.images.dtype != np.uint8,
        "rectified or coloured events": any(one.rectified or one.coloured for one in streams),
        "events of unknown thresholds": capture.known.thresholds is None,
    }
    found = [what for what, wrong in problems.items() if wrong]
    if found:
        raise CaptureError(
            f"EvDNeRF's layout cannot store {found[0]}",
            where=capture.name,
            do="write it in our own layout",
        )
