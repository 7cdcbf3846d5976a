"""Staging folder of an ingestion, from which an interrupted one continues.

Beside the capture, a hidden folder `.NAME-ingest/` holds

    plan.json       input files and options; with another plan, everything starts over
    survey.npz      result of the first pass over the events
    frames.json     record of the frames, after the last one was written
    events.json     counts of the events, after the last one was written
    part-000.h5     events, a fixed number in each part
    capture/        the capture in the making

Each file appears complete or not at all, and the capture appears when all of it is there. Frames
are written one by one while they are read.
"""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from jaxtyping import Float32, Float64, Int64, Shaped

from sharpfield.captures.native import layout as native
from sharpfield.captures.native.frames import PLAIN_NAME
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing, write_json
from sharpfield.preparation.ingest.lens import CaptureGeometry
from sharpfield.preparation.ingest.survey import Survey
from sharpfield.recordings.recording import Frame
from sharpfield.storage.arrays import expect_replaceable, load_arrays, write_arrays
from sharpfield.storage.event_writer import ROWS, join_events, writing_events
from sharpfield.storage.images import write_image

PART = 512 * ROWS
"""Events in a part; so many may have to be written again, about a second of work."""

PLAN = "plan.json"


class StagingFolder:
    """The staging folder of the capture at `out`; the plan is JSON values.

    Raises:
        CaptureError: `out` exists and is no capture, or the staging folder is not ours.
    """

    def __init__(self, out: Path, plan: dict[str, Any], *, part: int = PART) -> None:
        expect_replaceable(out, native.recognise)
        self._out, self._part = out, part
        self.folder = out.resolve().parent / f".{out.resolve().name}-ingest"
        self.capture = self.folder / "capture"
        """Folder of the capture in the making."""
        self.frames_record = self.folder / "frames.json"
        """The record of the frames."""
        self.events_record = self.folder / "events.json"
        """The counts of the events."""
        plan_file = self.folder / PLAN
        self.resumed = plan_file.is_file() and plan_file.read_text() == json.dumps(plan)
        if not self.resumed:
            if self.folder.exists() and not plan_file.is_file():
                raise CaptureError(
                    "the staging folder exists and is not one of ours",
                    where=self.folder,
                    do="move that folder away",
                )
            shutil.rmtree(self.folder, ignore_errors=True)
            self.capture.mkdir(parents=True)
            with replacing(plan_file) as temporary:
                temporary.write_text(json.dumps(plan))

    def save_survey(self, survey: Survey) -> None:
        """Save the result of the first pass."""
        with replacing(self.folder / "survey.npz") as temporary:
            write_arrays(
                temporary, {name: np.asarray(value) for name, value in vars(survey).items()}
            )

    def load_survey(self) -> Survey | None:
        """Result of the first pass; None if there was none."""
        path = self.folder / "survey.npz"
        if not path.is_file():
            return None
        arrays = load_arrays(path)
        count, first_us, last_us = (int(arrays[name]) for name in ("count", "first_us", "last_us"))
        return Survey(count, first_us, last_us, arrays["events_per_pixel"], arrays["events_per_ms"])

    def write(
        self, parts: Iterator[EventStream], like: EventStream, span_us: tuple[int, int]
    ) -> None:
        """Write the events that earlier attempts have not written yet.

        Args:
            parts: All events of the capture, from the first one.
            like: A stream of the same sensor.
            span_us: First and last time of the capture.
        """
        written = self._parts()
        done = sum(_count(path) for path in written)
        slices = _cut(_skip(parts, done), self._part)
        number = len(written)
        events, full = next(slices, (like, True))
        while number == len(written) or len(events):
            with writing_events(
                self.folder / f"part-{number:03d}.h5",
                like,
                span_us=span_us[1] - span_us[0] + 1000,
                origin_us=span_us[0] // 1000 * 1000,
            ) as writer:
                writer.append(events)
                while not full:
                    events, full = next(slices, (like, True))
                    writer.append(events)
            number += 1
            events, full = next(slices, (like, True))

    def join(self) -> None:
        """Join the parts to one event file."""
        parts = self._parts()
        if len(parts) > 1 and not _count(parts[-1]):
            parts.pop().unlink()
        if len(parts) == 1:
            parts[0].replace(self.capture / native.EVENTS)
        elif parts:
            join_events(self.capture / native.EVENTS, parts)
            for part in parts:
                part.unlink()

    def finish(self) -> None:
        """Move the capture to its final path."""
        old = self.folder / "replaced"
        if self._out.exists():
            self._out.rename(old)
        self.capture.rename(self._out)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("part-*.h5"))


def fingerprint(path: Path) -> list[Any]:
    """Path, number of files, bytes and time of the last change of a file or folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    entries = [file.stat() for file in files if file.is_file()]
    newest = max((entry.st_mtime_ns for entry in entries), default=0)
    return [str(path.resolve()), len(entries), sum(entry.st_size for entry in entries), newest]


def as_json(options: Any) -> Any:
    """A frozen dataclass of options as JSON values."""
    return json.loads(json.dumps(asdict(options), default=str))


def _count(path: Path) -> int:
    with h5py.File(path, "r") as file:
        times: Any = file["events/t"]
        return len(times)


def _skip(parts: Iterator[EventStream], done: int) -> Iterator[EventStream]:
    """Skip the first `done` events."""
    for part in parts:
        skipped = min(done, len(part))
        done -= skipped
        if len(part) > skipped:
            yield part[skipped:]


def _cut(parts: Iterator[EventStream], each: int) -> Iterator[tuple[EventStream, bool]]:
    """Slices of at most `each` events, and whether a slice completes a part."""
    room = each
    for part in parts:
        first = 0
        while first < len(part):
            events = part[first : first + room]
            first, room = first + len(events), room - len(events)
            yield events, not room
            room = room or each


CHANGE_WIDTH = 64
"""Width in pixels to which images are reduced to measure their change."""
FLOOR = 1 / 255
"""Lower limit of light before the logarithm."""


@dataclass(frozen=True)
class WrittenFrames:
    """Frames that were written."""

    names: tuple[str, ...]
    """File names without `.png`."""
    open_us: Int64[np.ndarray, "n"]
    close_us: Int64[np.ndarray, "n"]
    change: Float64[np.ndarray, "m"]
    """Mean absolute change of log light from each image to the next."""
    shape: tuple[int, int, int]
    bits: int

    def selected(self, keep: Shaped[np.ndarray, "n"]) -> "WrittenFrames":
        """Some of the frames, without their changes."""
        names, opens, closes = np.array(self.names)[keep], self.open_us[keep], self.close_us[keep]
        return replace(
            self, names=tuple(names.tolist()), open_us=opens, close_us=closes, change=np.empty(0)
        )


def write_frames(
    frames: Iterator[Frame],
    folder: Path,
    lens: CaptureGeometry,
    bayer: str,
    progress: Callable[[int], None],
) -> WrittenFrames:
    """Write all frames to a folder; files that exist already are kept.

    Args:
        frames: Frames in the order of time.
        folder: Folder of the images.
        lens: Maps images to the pixels of the capture.
        bayer: Colour filter array of the sensor, where images are raw.
        progress: Called with the number of frames written.

    Raises:
        CaptureError: There are no frames, or they differ in size or type.
    """
    names: list[str] = []
    known: set[str] = set()
    times: list[tuple[int, int]] = []
    change: list[float] = []
    before: Float32[np.ndarray, "y x"] | None = None
    shape: tuple[int, int, int] | None = None
    bits = 8
    for number, frame in enumerate(frames):
        image = lens.mapped_image(frame.image, bayer)
        bits = 8 * image.dtype.itemsize
        if shape is not None and image.shape != shape:
            raise CaptureError(
                "frames differ in size or colour",
                where=f"frame {frame.name or number}",
                got=f"{image.shape} after {shape}",
                do="record with one setting of the camera",
            )
        shape = image.shape[0], image.shape[1], image.shape[2]
        names.append(_name(frame.name, number, known))
        times.append((frame.open_us, frame.close_us))
        file = folder / f"{names[-1]}.png"
        if not file.exists():
            write_image(file, image)
        small = _log_small(image)
        if before is not None:
            change.append(float(np.abs(small - before).mean()))
        before = small
        progress(number + 1)
    if shape is None:
        raise CaptureError("the recording holds no frames", where=folder)
    opens, closes = np.array(times, np.int64).T
    return WrittenFrames(tuple(names), opens, closes, np.array(change), shape, bits)


def save_frames(frames: WrittenFrames, path: Path) -> None:
    """Save the record of all frames after the last one was written."""
    lists = {name: getattr(frames, name).tolist() for name in ("open_us", "close_us", "change")}
    write_json(path, vars(frames) | lists)


def load_frames(path: Path) -> WrittenFrames:
    """Load what `save_frames` saved."""
    record = json.loads(path.read_text())
    height, width, channels = record["shape"]
    return WrittenFrames(
        tuple(record["names"]),
        np.array(record["open_us"], np.int64),
        np.array(record["close_us"], np.int64),
        np.array(record["change"], np.float64),
        (height, width, channels),
        record["bits"],
    )


def _name(own: str, number: int, known: set[str]) -> str:
    """The frame's own name if it is new and valid on every file system, else its number."""
    stem = re.sub(r"\.(png|jpe?g)$", "", own, flags=re.I)
    for name in (stem, f"{number:06d}"):
        if PLAIN_NAME.fullmatch(name) and name.casefold() not in known:
            known.add(name.casefold())
            return name
    known.add(f"frame_{number:06d}")
    return f"frame_{number:06d}"


def _log_small(image: Shaped[np.ndarray, "h w c"]) -> Float32[np.ndarray, "y x"]:
    """Logarithm of an image that is reduced to `CHANGE_WIDTH`."""
    height, width = image.shape[:2]
    grey = image.mean(-1, dtype=np.float32) / np.iinfo(image.dtype).max
    scale = min(CHANGE_WIDTH / width, 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.log(np.maximum(small, FLOOR))
