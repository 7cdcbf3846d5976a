"""Recordings of frames only: a video file, or a folder of images with a file of their times.

A video stores the time at which each frame is shown, which is the time of recording except in slow
motion; then the caller gives the frame rate. For a folder, times come from one of

    images.txt                       RPG: a line `t path` for each image, t in s
    *exposure*.txt                   DSEC: `start, end`; or a file of starts and one of ends (EVDI)
    *timestamp*.txt, *times*.txt     one time per line
    timestamps.npz                   Ev-DeblurNeRF: `timestamps_start`, `timestamps_end`

beside the images or in the folder above. Only RPG's text implies a unit; for the others the caller
gives it, unless the header line names it.

Source: Mueggler et al., *The Event-Camera Dataset and Simulator* (IJRR 2017), for `images.txt`;
the others from published data sets.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from jaxtyping import Int64, Shaped

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Format,
    Frame,
    ReaderOptions,
    ReadLog,
    Recording,
)
from sharpfield.storage.arrays import load_arrays
from sharpfield.storage.event_columns import UNITS, known_unit, whole_us
from sharpfield.storage.images import list_images, read_image

MAX_FPS = 1e6
"""Times are whole us."""

HEADER_UNIT = re.compile(r"\b(ns|us|ms|s)\b|_(ns|us|ms|s)\b|\[(ns|us|ms|s)\]")
"""A unit in a header line."""

Times = tuple[Int64[np.ndarray, "n"], Int64[np.ndarray, "n"]]
"""Start and end of each exposure in us; equal where only one time is known."""


def open_video(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a video.

    Args:
        path: A file that FFmpeg decodes.
        options: `fps`, the rate of recording, where it differs from the rate of playback.

    Raises:
        CaptureError: The file cannot be decoded, or holds no video.
    """
    interval_us = None if options.fps is None else 1e6 / _checked_fps(options.fps)
    log = ReadLog()
    first = next(_decoded(path, interval_us, ReadLog()), None)
    if first is None:
        raise CaptureError("the video holds no frames", where=path, do="copy or convert it again")
    return Recording(
        path,
        "video",
        frames=lambda: _decoded(path, interval_us, log.start("frames")),
        log=log,
        frame_encoding="srgb",
        notes={"frame_size": f"{first.image.shape[1]}x{first.image.shape[0]}"},
    )


def open_images(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a folder of images.

    Args:
        path: The folder; or one that has the images in `images/`, and `images.txt`.
        options: `frame_unit` of the times, where their file does not give it; `fps`, where there is
            no file of times; `times`, that file, where there are several candidates.

    Raises:
        CaptureError: There are no images, or their times are unknown.
    """
    listed = path / "images.txt"
    if options.times is None and options.fps is None and listed.is_file():
        files, (opens, closes) = _rpg(listed)
    else:
        files = list_images(path) or (
            list_images(path / "images") if (path / "images").is_dir() else []
        )
        if not files:
            raise CaptureError("no images found", where=path, do="put PNG or JPEG files there")
        opens, closes = _times(files, options)
    if len(opens) != len(files):
        raise CaptureError(
            "there must be one time for each image",
            where=path,
            got=f"{len(files)} images, {len(opens)} times",
        )

    def frames() -> Iterator[Frame]:
        for file, open_us, close_us in zip(files, opens.tolist(), closes.tolist(), strict=True):
            yield Frame(read_image(file), open_us, close_us, file.stem)

    return Recording(path, "images", frames=frames, frame_encoding="srgb")


def _decoded(path: Path, interval_us: float | None, log: ReadLog) -> Iterator[Frame]:
    """Frames of a video, up to the first that cannot be decoded."""
    count = 0
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            if not container.streams.video:
                raise CaptureError("the file holds no video", where=path)
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                if interval_us is not None:
                    t_us = round(count * interval_us)
                elif frame.pts is None or frame.time_base is None:
                    raise CaptureError(
                        "the video does not say when its frames were taken",
                        where=f"{path}, frame {count}",
                        do="give the frames per second",
                    )
                else:
                    t_us = round(frame.pts * frame.time_base * 1_000_000)
                yield Frame(_pixels(frame), t_us, t_us, f"{count:06d}")
                count += 1
    except FFmpegError as error:
        if not count:
            raise CaptureError(
                "not a video that can be decoded", where=path, got=error, do="convert it again"
            ) from None
        log.note("truncated ends of videos")


def _pixels(frame: av.VideoFrame) -> Shaped[np.ndarray, "h w *c"]:
    """Pixels as grey or RGB; uint16 for more than 8 bits."""
    deep = any(component.bits > 8 for component in frame.format.components)
    if len(frame.format.components) == 1 and not frame.format.is_bayer:
        return frame.to_ndarray(format="gray16le" if deep else "gray")
    return frame.to_ndarray(format="rgb48le" if deep else "rgb24")


def _times(files: list[Path], options: ReaderOptions) -> Times:
    if options.fps is not None:
        interval_us = 1e6 / _checked_fps(options.fps)
        instants = np.rint(np.arange(len(files)) * interval_us).astype(np.int64)
        return instants, instants
    folder = files[0].parent
    sources = _candidates(folder) if options.times is None else [(options.times,)]
    if len(sources) != 1:
        raise CaptureError(
            "nothing says when the images were taken"
            if not sources
            else "several files may say when the images were taken",
            where=folder,
            got=", ".join(path.name for source in sources for path in source),
            do="give the frames per second, or the file of times"
            if not sources
            else "name one of them as the file of times",
        )
    return _read_times(sources[0], options.frame_unit)


def _candidates(folder: Path) -> list[tuple[Path, ...]]:
    """Files that may hold the times of the images in a folder; a pair for starts and ends."""
    for parent in (folder, folder.parent):
        texts = [path for path in sorted(parent.glob("*.txt")) if path.name != "images.txt"]
        named = [path for path in texts if re.search("exposure|timestamp|times", path.name, re.I)]
        starts = [path for path in named if re.search("start", path.name, re.I)]
        ends = [path for path in named if re.search("end", path.name, re.I)]
        if len(starts) == len(ends) == 1 and starts != ends:
            return [(starts[0], ends[0])]
        exposures = [path for path in named if re.search("exposure", path.name, re.I)]
        arrays = [path for path in (parent / "timestamps.npz",) if path.is_file()]
        if exposures or named or arrays:
            return [(path,) for path in [*(exposures or named), *arrays]]
    return []


def _read_times(source: tuple[Path, ...], unit: str | None) -> Times:
    if source[0].suffix == ".npz":
        arrays = load_arrays(source[0])
        names = ("timestamps_start", "timestamps_end")
        if not set(names) <= arrays.keys():
            names = ("timestamps", "timestamps")
        if not set(names) <= arrays.keys():
            raise CaptureError(
                "no times of images found", where=source[0], got=", ".join(arrays) or "no arrays"
            )
        columns, header_unit = [arrays[name].reshape(-1) for name in names], None
    elif len(source) == 2:
        (starts, header_unit), (ends, _) = (_table(path) for path in source)
        columns = [starts[:, 0], ends[:, 0]]
    else:
        table, header_unit = _table(source[0])
        columns = [table[:, 0], table[:, min(1, table.shape[1] - 1)]]
    if len(columns[0]) != len(columns[1]):
        raise CaptureError(
            "there must be an end for each start of an exposure",
            where=" and ".join(map(str, source)),
            got=f"{len(columns[0])} and {len(columns[1])}",
        )
    unit = unit or header_unit
    if unit is None:
        raise _no_unit(source[0], columns[0])
    opens, closes = (whole_us(column, known_unit(unit), source[0]) for column in columns)
    return opens, closes


def _table(path: Path) -> tuple[Shaped[np.ndarray, "n k"], str | None]:
    """Numbers of a text file, and the unit that its header line names."""
    rows, header_unit = [], None
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines()):
        words = line.replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([int(word) if word.isdecimal() else float(word) for word in words])
        except ValueError:
            if rows:
                raise CaptureError(
                    "cannot read a time", where=f"{path}, line {number + 1}", got=line[:60]
                ) from None
            units = {unit for match in HEADER_UNIT.findall(line) for unit in match if unit}
            header_unit = units.pop() if len(units) == 1 else header_unit
    if not rows or len({len(row) for row in rows}) != 1:
        raise CaptureError(
            "a file of times needs the same number of columns in each line",
            where=path,
            got=f"{len(rows)} lines of {sorted({len(row) for row in rows})} columns",
        )
    return np.array(rows), header_unit


def _rpg(listed: Path) -> tuple[list[Path], Times]:
    """Images and times listed in `images.txt`."""
    files, seconds = [], []
    for number, line in enumerate(listed.read_text(encoding="utf-8").splitlines()):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            seconds.append(float(words[0]))
            file = listed.parent / words[1].strip()
        except (ValueError, IndexError):
            raise CaptureError(
                "a line must be a time and the path of an image",
                where=f"{listed}, line {number + 1}",
                got=line[:60],
            ) from None
        if not file.resolve().is_relative_to(listed.parent.resolve()):
            raise CaptureError("an image lies outside the recording", where=listed, got=file)
        files.append(file)
    if not files:
        raise CaptureError("no images are listed", where=listed)
    times_us = whole_us(np.array(seconds), "s", listed)
    return files, (times_us, times_us)


def _no_unit(path: Path, column: Shaped[np.ndarray, "n"]) -> CaptureError:
    span = float(column[-1]) - float(column[0])
    lasts = ", ".join(f"{span * UNITS[unit] / 1e6:.4g} s if {unit}" for unit in UNITS)
    return CaptureError(
        "nothing says in which unit the times of images are",
        where=path,
        got=f"{column[0]} to {column[-1]}, which is {lasts}",
        do="give the unit: ns, us, ms or s",
    )


def _checked_fps(fps: float) -> float:
    if not 0 < fps <= MAX_FPS:
        raise OptionError("frames per second must be between 0 and a million", got=fps)
    return fps


def _is_video(path: Path, head: bytes) -> bool:
    riff = head.startswith(b"RIFF") and head[8:11] == b"AVI"
    return riff or head[4:8] == b"ftyp" or head.startswith(b"\x1aE\xdf\xa3")


def _has_images(path: Path, head: bytes) -> bool:
    others = ("events.txt", "metadata.yaml")
    if not path.is_dir() or any((path / name).is_file() for name in others):
        return False
    return (path / "images.txt").is_file() or bool(list_images(path))


VIDEO = Format(
    "video",
    open_video,
    holds="frames",
    marks="mp4, avi, mkv",
    recognise=_is_video,
    suffixes=(".mp4", ".avi", ".mov", ".mkv", ".webm"),
    options=("fps",),
)
IMAGES = Format(
    "images",
    open_images,
    holds="frames",
    marks="a folder of PNG or JPEG",
    recognise=_has_images,
    options=("frame_unit", "fps", "times"),
)
