"""From a recording to a capture: what the camera wrote, checked, cleaned and on one clock.

Nothing is held in memory but a chunk of events and a frame, and nothing is lost when it is
interrupted: the same call goes on (`preparation.ingest_stage`). Whatever is left out is counted
and told. What nobody knows yet, poses above all, is a stand-in and a note says so: see
`captures.native.read_unposed`.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sharpfield.captures.native import layout as native
from sharpfield.captures.paths.pose_file import read_poses
from sharpfield.core.capture import HELD_BACK_US, Capture, Clock, Known, Note, Split
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import write_json
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry.trajectory import Stamped, Still
from sharpfield.preparation.ingest.clock import (
    accepted_offset,
    find_offset,
    shifted,
    triggered,
    with_length,
)
from sharpfield.preparation.ingest.frames import (
    WrittenFrames,
    load_frames,
    save_frames,
    write_frames_of,
)
from sharpfield.preparation.ingest.lens import DEMOSAIC, Geometry, geometry, no_events
from sharpfield.preparation.ingest.options import IngestOptions, roles
from sharpfield.preparation.ingest.stage import Stage, fingerprint, plain
from sharpfield.preparation.ingest.survey import Sieve, Survey, hot_pixels, survey
from sharpfield.recordings.recording import Recording

NEAR, FAR = 1.0, 100.0
"""Stand-ins for the depth bounds of a scene that nobody has measured."""

Progress = Callable[[str, int, int | None], None]
"""Is told what is going on, how much of it is done, and how much there is, if that is known."""


@dataclass(frozen=True)
class Ingested:
    """What became of a recording."""

    events: int
    """Kept."""
    frames: int
    span_us: tuple[int, int]
    left_out: dict[str, int]
    """What was left out, by reason."""
    hot_pixels: int
    clock: str
    """How frames came to the clock of the events."""
    unknown: tuple[str, ...]
    """What is unknown yet: poses, intrinsics, depth bounds."""


def ingest(
    recordings: tuple[Recording, ...], out: Path, choices: IngestOptions, tell: Progress
) -> Ingested:
    """Make a capture of one recording, or of two that were taken together.

    Args:
        recordings: One that has events, frames or both; or one that has events, and one that has
            the frames.
        out: Folder of the capture.
        choices: How.
        tell: Is told of the progress.

    Raises:
        CaptureError: A recording is unsound, or something is not known and must be given.
        OptionError: Choices do not fit each other.
    """
    events, frames = roles(recordings)
    plan = {
        "files": [fingerprint(recording.path) for recording in recordings],
        "layouts": [recording.layout for recording in recordings],
        "choices": plain(choices),
    }
    stage = Stage(out, plan)
    return _Ingest(events, frames, choices, stage, tell).run(out.name)


class _Ingest:
    """One recording on its way; the steps in their order."""

    def __init__(
        self,
        events: Recording | None,
        frames: Recording | None,
        choices: IngestOptions,
        stage: Stage,
        tell: Progress,
    ) -> None:
        self._events, self._frames = events, frames
        self._choices, self._stage, self._tell = choices, stage, tell
        self._left: dict[str, int] = {}
        self._where = (events or frames or Recording(Path(), "")).path

    def run(self, name: str) -> Ingested:
        found = self._survey() if self._events is not None else None
        lens = self._geometry()
        taken = self._take(lens) if self._frames is not None else None
        exposure, clock = self._exposure(taken, found) if taken is not None else (None, "")
        span = self._span(found, exposure)
        sieve = self._write_events(found, lens, span) if found is not None else None
        left = self._left | ({} if sieve is None else sieve.left_out())
        if taken is not None and exposure is not None:
            taken, exposure, dropped = self._crop(taken, exposure, span)
            left |= dropped
        capture = self._capture(name, lens, taken, exposure, span)
        self._seal(replace(capture, notes=self._notes(lens, sieve, left, clock)), taken)
        return Ingested(
            events=0
            if found is None or sieve is None
            else found.count - sum(sieve.left_out().values()),
            frames=0 if taken is None else len(taken.names),
            span_us=span,
            left_out=left,
            hot_pixels=0 if sieve is None else len(sieve.hot),
            clock=clock,
            unknown=capture.known.unknown,
        )

    def _survey(self) -> Survey:
        known = self._stage.load_frames()
        if known is not None:
            return known
        assert self._events is not None
        if self._events.size is None:
            raise CaptureError(
                "the recording does not say the size of its sensor",
                where=self._events.path,
                do="give width and height in pixels",
            )
        found = survey(
            self._events.chunks(),
            self._events.size,
            self._events.path,
            lambda count: self._tell("looking through events", count, None),
        )
        if not found.count:
            raise CaptureError("the recording holds no events", where=self._events.path)
        self._stage.save_frames(found)
        self._heed(self._events)
        return found

    def _geometry(self) -> Geometry:
        frame_size = None
        if self._frames is not None and self._frames.frames is not None:
            first = next(self._frames.frames(), None)
            if first is None:
                raise CaptureError("the recording holds no frames", where=self._frames.path)
            frame_size = first.image.shape[1], first.image.shape[0]
        sensor = None if self._events is None else self._events.size
        return geometry(sensor, frame_size, self._choices.optics, self._where)

    def _take(self, lens: Geometry) -> WrittenFrames:
        if self._stage.frames.is_file():
            return load_frames(self._stage.frames)
        assert self._frames is not None and self._frames.frames is not None
        taken = write_frames_of(
            self._frames.frames(),
            self._stage.capture / "frames",
            lens,
            self._bayer(self._frames),
            lambda count: self._tell("writing frames", count, None),
        )
        save_frames(taken, self._stage.frames)
        self._heed(self._frames)
        return taken

    def _bayer(self, recording: Recording) -> str:
        given = self._choices.scene.bayer
        if given not in (None, "none", *DEMOSAIC):
            raise OptionError(
                "unknown colour filter", got=given, do=f"use none, {', '.join(DEMOSAIC)}"
            )
        return recording.bayer if given is None else given.replace("none", "")

    def _event_bayer(self, lens: Geometry) -> str:
        """The filter before the event sensor; images of another sensor say nothing about it."""
        assert self._events is not None
        if self._choices.scene.bayer is None and lens.separate:
            return ""
        return self._bayer(self._events)

    def _exposure(self, taken: WrittenFrames, found: Survey | None) -> tuple[Exposure, str]:
        """When frames were exposed, on the clock of the events; and how that is known."""
        timing = self._choices.timing
        exposure = Exposure(taken.open_us, taken.close_us)
        if timing.exposure is not None:
            exposure = with_length(exposure, timing.exposure, timing.stamp)
        if timing.offset_ms is not None:
            return shifted(exposure, round(1000 * timing.offset_ms)), (
                f"frames are {timing.offset_ms} ms later than they say, as given"
            )
        apart = self._frames is not self._events and found is not None
        if not apart or timing.clock == "same":
            return exposure, ""
        assert found is not None and self._events is not None
        if timing.clock != "find" and self._events.triggers is not None:
            triggers = self._events.triggers()
            if len(triggers.t_us):
                pulses = triggered(
                    triggers, len(exposure), channel=timing.trigger_channel, where=self._where
                )
                return pulses, "frames were exposed while the trigger was up"
        if timing.clock == "triggers":
            raise CaptureError("the recording holds no triggers", where=self._where)
        offset = find_offset(taken.change, exposure.middle_us, found.per_ms, found.origin_us)
        return shifted(
            exposure, accepted_offset(offset, self._where)
        ), f"frames came later by {offset}"

    def _span(self, found: Survey | None, exposure: Exposure | None) -> tuple[int, int]:
        """First and last time of the capture."""
        ends = [] if found is None else [(found.first_us, found.last_us)]
        if exposure is not None:
            ends.append((int(exposure.open_us.min()), int(exposure.close_us.max())))
        zero = ends[0][0]
        first, last = min(begin for begin, _ in ends), max(end for _, end in ends)
        crop = self._choices.crop
        if crop.start_ms is not None:
            first = max(first, zero + round(1000 * crop.start_ms))
        if crop.end_ms is not None:
            last = min(last, zero + round(1000 * crop.end_ms))
        if last <= first:
            raise OptionError(
                "nothing was recorded in this time",
                got=f"{crop.start_ms} to {crop.end_ms} ms after the first event",
            )
        return first, last

    def _write_events(self, found: Survey, lens: Geometry, span: tuple[int, int]) -> Sieve:
        """Write the events that are kept."""
        assert self._events is not None and self._events.size is not None
        cleaning = self._choices.cleaning
        sieve = Sieve(
            hot_pixels(found.per_pixel, cleaning.hot),
            round(1000 * cleaning.lonely_ms),
            span,
            self._events.size,
        )
        if self._stage.events.is_file():
            told = json.loads(self._stage.events.read_text())
            sieve.of_hot, sieve.lonely, sieve.outside = told["sifted"]
            self._left |= told["left_out"]
        else:
            bayer = self._event_bayer(lens)
            self._stage.write(
                (lens.placed(sieve.sifted(chunk), bayer) for chunk in self._told(found.count)),
                lens.placed(no_events(self._events.size), bayer),
                span,
            )
            self._heed(self._events)
            told = {
                "sifted": [sieve.of_hot, sieve.lonely, sieve.outside],
                "left_out": self._left,
            }
            write_json(self._stage.events, told)
        self._stage.join()
        return sieve

    def _told(self, count: int) -> Iterator[EventStream]:
        """All events, while the progress is told."""
        assert self._events is not None
        done = 0
        for chunk in self._events.chunks():
            yield chunk
            done += len(chunk)
            self._tell("writing events", done, count)

    def _heed(self, recording: Recording) -> None:
        """Keep what a pass through a recording left out; each pass meets the same."""
        for kind, count in recording.log.counts.items():
            self._left[kind] = max(self._left.get(kind, 0), count)

    def _crop(
        self, taken: WrittenFrames, exposure: Exposure, span: tuple[int, int]
    ) -> tuple[WrittenFrames, Exposure, dict[str, int]]:
        """The frames whose exposures lie in the time to keep, and while the poses are known."""
        inside = (exposure.open_us >= span[0]) & (exposure.close_us <= span[1])
        posed = np.ones(len(exposure), bool)
        if self._choices.scene.poses is not None:
            times_us, _ = read_poses(self._choices.scene.poses)
            posed = (exposure.open_us >= times_us[0] - HELD_BACK_US) & (
                exposure.close_us <= times_us[-1] + HELD_BACK_US
            )
        keep = inside & posed
        if not keep.any():
            raise CaptureError(
                "no frame was taken while the poses are known"
                if inside.any()
                else "no frame was taken in this time",
                where=self._where,
                got=f"frames from {exposure.open_us.min()} to {exposure.close_us.max()} us",
                do="check that both count from the same instant, and the units",
            )
        for name in np.array(taken.names)[~keep]:
            (self._stage.capture / "frames" / f"{name}.png").unlink(missing_ok=True)
        dropped = {
            "frames outside the time to keep": int((~inside).sum()),
            "frames without poses": int((inside & ~posed).sum()),
        }
        return (
            taken.picked(keep),
            Exposure(exposure.open_us[keep], exposure.close_us[keep]),
            {kind: count for kind, count in dropped.items() if count},
        )

    def _capture(
        self,
        name: str,
        lens: Geometry,
        taken: WrittenFrames | None,
        exposure: Exposure | None,
        span: tuple[int, int],
    ) -> Capture:
        clock = Clock(span[0], max(span[1] - span[0], 1))
        scene = self._choices.scene
        frames = None
        if taken is not None and exposure is not None:
            blank = np.zeros((), f"uint{taken.bits}")
            frames = Frames(
                # What is checked of frames is all but their pixels, which are on disk already.
                np.broadcast_to(blank, (len(taken.names), *taken.shape)),
                exposure,
                np.zeros(len(taken.names), np.int64),
                taken.names,
                scene.encoding or self._encoding(),
            )
        events = None if self._events is None else no_events(self._events.size or (1, 1))
        return Capture(
            camera=lens.camera,
            trajectory=self._trajectory(clock),
            clock=clock,
            near=scene.near or NEAR,
            far=scene.far or FAR,
            frames=frames,
            events=events,
            split=Split(np.arange(0 if frames is None else len(frames)), np.zeros(0, np.int64)),
            name=name,
            known=self._known(lens),
            source=" and ".join(dict.fromkeys(r.layout for r in (self._events, self._frames) if r)),
        )

    def _encoding(self) -> str:
        assert self._frames is not None
        raw = self._bayer(self._frames)
        return self._frames.frame_encoding or ("linear" if raw else "gamma2.2")

    def _trajectory(self, clock: Clock) -> Trajectory:
        if self._choices.scene.poses is None:
            return Still(np.eye(3, 4)[None])
        times_us, poses = read_poses(self._choices.scene.poses)
        return Stamped(times_us, poses, clock)

    def _notes(
        self, lens: Geometry, sieve: Sieve | None, left: dict[str, int], clock: str
    ) -> dict[str, Note]:
        notes: dict[str, Note] = {**lens.notes} | ({"clock": clock} if clock else {})
        if left:
            notes["left_out"] = ", ".join(f"{count} {kind}" for kind, count in left.items())
        if sieve is not None and len(sieve.hot):
            notes["hot_pixels"] = sieve.hot
        return notes

    def _known(self, lens: Geometry) -> Known:
        scene = self._choices.scene
        return Known(
            poses="unknown" if scene.poses is None else "known",
            intrinsics=lens.intrinsics,
            bounds="unknown" if None in (scene.near, scene.far) else "known",
            thresholds=None if self._events is None else self._events.thresholds,
        )

    def _seal(self, capture: Capture, taken: WrittenFrames | None) -> None:
        """Write the description, and let the capture take its place."""
        tables = None
        if taken is not None and capture.frames is not None:
            exposure = capture.frames.exposure
            shutter = zip(taken.names, exposure.open_us, exposure.close_us, strict=True)
            tables = [
                {"name": name, "open_us": int(begin), "close_us": int(end), "use": "train"}
                for name, begin, end in shutter
            ]
        native.describe(capture, self._stage.capture, frames=tables)
        self._stage.finish()
