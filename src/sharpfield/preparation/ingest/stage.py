"""Where a capture grows while a recording is ingested: interrupt it, and it goes on from there.

Beside the capture to be, a hidden folder `.NAME-ingest/` holds

    plan.json       which files are ingested, and how; another plan starts anew
    survey.npz      what the first look at the events found
    frames.json     which frames were written, once all were
    events.json     what became of the events, once all were written
    part-000.h5     events, so many in each part
    capture/        what becomes the capture

Each file appears whole or not at all, and the capture appears when all is there.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sharpfield.captures.native import layout as native
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing
from sharpfield.preparation.ingest.survey import Survey
from sharpfield.storage.arrays import expect_replaceable, load_arrays, write_arrays
from sharpfield.storage.event_writer import ROWS, join_events, writing_events

PART = 512 * ROWS
"""Events in a part: as many as may have to be written again, about a second's work."""

PLAN = "plan.json"


class Stage:
    """The folder in which a capture grows.

    Args:
        out: Where the capture will be.
        plan: Of what it is made, ready for JSON.

    Raises:
        CaptureError: Something that is not a capture is at `out`.
    """

    def __init__(self, out: Path, plan: dict[str, Any], *, part: int = PART) -> None:
        expect_replaceable(out, native.recognise)
        self._out, self._part = out, part
        self.folder = out.resolve().parent / f".{out.resolve().name}-ingest"
        told = self.folder / PLAN
        self.resumed = told.is_file() and told.read_text() == json.dumps(plan)
        if not self.resumed:
            self._expect_own()
            shutil.rmtree(self.folder, ignore_errors=True)
            self.capture.mkdir(parents=True)
            with replacing(told) as temporary:
                temporary.write_text(json.dumps(plan))

    @property
    def capture(self) -> Path:
        """What becomes the capture."""
        return self.folder / "capture"

    @property
    def frames(self) -> Path:
        """Where it is told which frames were written."""
        return self.folder / "frames.json"

    @property
    def events(self) -> Path:
        """Where it is told what became of the events."""
        return self.folder / "events.json"

    def save_frames(self, survey: Survey) -> None:
        """Keep the first look."""
        with replacing(self.folder / "survey.npz") as temporary:
            write_arrays(
                temporary,
                {name: np.asarray(value) for name, value in vars(survey).items()},
            )

    def load_frames(self) -> Survey | None:
        """The first look, if there was one."""
        path = self.folder / "survey.npz"
        if not path.is_file():
            return None
        found = load_arrays(path)
        count, first_us, last_us = (int(found[name]) for name in ("count", "first_us", "last_us"))
        return Survey(count, first_us, last_us, found["per_pixel"], found["per_ms"])

    def write(
        self, parts: Iterator[EventStream], like: EventStream, span_us: tuple[int, int]
    ) -> None:
        """Write the events that earlier attempts have not written yet.

        Args:
            parts: All events of the capture, from the first one.
            like: A stream of the same sensor.
            span_us: Of the capture.
        """
        written = self._parts()
        done = sum(_count(path) for path in written)
        pieces = _cut(_after(parts, done), self._part)
        number = len(written)
        piece, full = next(pieces, (like, True))
        while number == len(written) or len(piece):
            with writing_events(
                self.folder / f"part-{number:03d}.h5",
                like,
                span_us=span_us[1] - span_us[0] + 1000,
                origin_us=span_us[0] // 1000 * 1000,
            ) as writer:
                writer.append(piece)
                while not full:
                    piece, full = next(pieces, (like, True))
                    writer.append(piece)
            number += 1
            piece, full = next(pieces, (like, True))

    def join(self) -> None:
        """Make one file of the parts."""
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
        """Let the capture take its place."""
        old = self.folder / "replaced"
        if self._out.exists():
            self._out.rename(old)
        self.capture.rename(self._out)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("part-*.h5"))

    def _expect_own(self) -> None:
        if self.folder.exists() and not (self.folder / PLAN).is_file():
            raise CaptureError(
                "the place where the capture should grow is taken",
                where=self.folder,
                do="move that folder away",
            )


def fingerprint(path: Path) -> list[Any]:
    """Changes when a file, or one of a folder's, is written again."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    about = [file.stat() for file in files if file.is_file()]
    newest = max((entry.st_mtime_ns for entry in about), default=0)
    return [str(path.resolve()), len(about), sum(entry.st_size for entry in about), newest]


def plain(options: Any) -> Any:
    """A frozen dataclass of options as JSON has it."""
    return json.loads(json.dumps(dataclasses.asdict(options), default=str))


def _count(path: Path) -> int:
    with h5py.File(path, "r") as file:
        times: Any = file["events/t"]
        return len(times)


def _after(parts: Iterator[EventStream], done: int) -> Iterator[EventStream]:
    """The events that come after the first so many."""
    for part in parts:
        skipped = min(done, len(part))
        done -= skipped
        if len(part) > skipped:
            yield part[skipped:]


def _cut(parts: Iterator[EventStream], each: int) -> Iterator[tuple[EventStream, bool]]:
    """Pieces, and whether one makes so many full."""
    room = each
    for part in parts:
        first = 0
        while first < len(part):
            piece = part[first : first + room]
            first, room = first + len(piece), room - len(piece)
            yield piece, not room
            room = room or each
