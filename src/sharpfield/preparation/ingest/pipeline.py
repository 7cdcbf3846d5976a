"""Ingestion: from recordings to a capture, checked, cleaned and on one clock.

Memory holds one chunk of events and one frame at a time. An interrupted ingestion continues with
the same call, see `ingest.stage`. Everything left out is counted and reported. What is unknown yet,
poses above all, is a placeholder, and `Capture.known` says so: see `captures.native`.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from sharpfield.captures.native import layout as native
from sharpfield.captures.trajectory_files import read_poses
from sharpfield.core.capture import (
    POSE_TOLERANCE_US,
    Capture,
    Clock,
    Known,
    Note,
    Split,
    Thresholds,
)
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import write_json
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry.trajectory import Stamped, Still
from sharpfield.preparation.ingest.clock import (
    accepted_offset,
    exposures_from_triggers,
    find_offset,
    shifted,
    with_exposure,
)
from sharpfield.preparation.ingest.lens import (
    CaptureGeometry,
    capture_geometry,
    colour_filter,
    empty_stream,
)
from sharpfield.preparation.ingest.options import (
    IngestOptions,
    IngestSummary,
    StepProgress,
    assign_roles,
)
from sharpfield.preparation.ingest.stage import (
    StagingFolder,
    WrittenFrames,
    as_json,
    fingerprint,
    load_frames,
    save_frames,
    write_frames,
)
from sharpfield.preparation.ingest.survey import EventFilter, Survey, hot_pixels, survey_events
from sharpfield.recordings.chunks import resolve_size
from sharpfield.recordings.recording import Recording

NEAR, FAR = 1.0, 100.0
"""Placeholders for unknown depth bounds."""


def ingest(
    recordings: tuple[Recording, ...], out: Path, options: IngestOptions, progress: StepProgress
) -> IngestSummary:
    """Make a capture of one recording, or of two that were recorded together.

    Args:
        recordings: One with events, frames or both; or one with events and one with frames.
        out: Folder of the capture.
        options: All options.
        progress: Called with the progress of each step.

    Raises:
        CaptureError: A recording is invalid, or something unknown must be given.
        OptionError: Options contradict each other.
    """
    events, frames = assign_roles(recordings)
    plan = {
        "files": [fingerprint(recording.path) for recording in recordings],
        "layouts": [recording.layout for recording in recordings],
        "options": as_json(options),
    }
    stage = StagingFolder(out, plan)
    return _Ingest(events, frames, options, stage, progress).run(out.name)


class _Ingest:
    """One ingestion; methods are its steps in their order."""

    def __init__(
        self,
        events: Recording | None,
        frames: Recording | None,
        options: IngestOptions,
        stage: StagingFolder,
        progress: StepProgress,
    ) -> None:
        self._events, self._frames = events, frames
        self._options, self._stage, self._progress = options, stage, progress
        self._dropped: dict[str, int] = {}
        """What the readers left out, by reason."""
        self._where = (events or frames or Recording(Path(), "")).path

    def run(self, name: str) -> IngestSummary:
        survey = self._survey() if self._events is not None else None
        geometry = self._geometry()
        frames = self._write_frames(geometry) if self._frames is not None else None
        exposure, clock = (None, "") if frames is None else self._exposure(frames, survey)
        span = self._span(survey, exposure)
        event_filter = None if survey is None else self._write_events(survey, geometry, span)
        removed = {} if event_filter is None else event_filter.left_out()
        left_out = self._dropped | removed
        if frames is not None and exposure is not None:
            frames, exposure, dropped = self._crop(frames, exposure, span)
            left_out |= dropped
        capture = self._capture(name, geometry, frames, exposure, span)
        notes = self._notes(geometry, event_filter, left_out, clock)
        self._finish(replace(capture, notes=notes), frames)
        return IngestSummary(
            events=0 if survey is None else survey.count - sum(removed.values()),
            frames=0 if frames is None else len(frames.names),
            span_us=span,
            left_out=left_out,
            hot_pixels=0 if event_filter is None else len(event_filter.hot),
            clock=clock,
            unknown=capture.known.unknown,
        )

    def _survey(self) -> Survey:
        """First pass over the events."""
        saved = self._stage.load_survey()
        if saved is not None:
            return saved
        assert self._events is not None
        survey = survey_events(
            self._events.chunks(),
            resolve_size(self._events.size, None, self._where),
            self._where,
            lambda count: self._progress("counting events", count, None),
        )
        if not survey.count:
            raise CaptureError("the recording holds no events", where=self._where)
        self._stage.save_survey(survey)
        self._log_dropped(self._events)
        return survey

    def _geometry(self) -> CaptureGeometry:
        frame_size = None
        if self._frames is not None and self._frames.frames is not None:
            first = next(self._frames.frames(), None)
            if first is None:
                raise CaptureError("the recording holds no frames", where=self._frames.path)
            frame_size = first.image.shape[1], first.image.shape[0]
        sensor = None if self._events is None else self._events.size
        return capture_geometry(sensor, frame_size, self._options.optics, self._where)

    def _write_frames(self, geometry: CaptureGeometry) -> WrittenFrames:
        if self._stage.frames_record.is_file():
            return load_frames(self._stage.frames_record)
        assert self._frames is not None and self._frames.frames is not None
        written = write_frames(
            self._frames.frames(),
            self._stage.capture / "frames",
            geometry,
            colour_filter(self._frames, self._options.scene.bayer),
            lambda count: self._progress("writing frames", count, None),
        )
        save_frames(written, self._stage.frames_record)
        self._log_dropped(self._frames)
        return written

    def _exposure(self, frames: WrittenFrames, survey: Survey | None) -> tuple[Exposure, str]:
        """Exposures on the clock of the events, and how they were determined."""
        timing = self._options.timing
        exposure = Exposure(frames.open_us, frames.close_us)
        if timing.exposure is not None:
            exposure = with_exposure(exposure, timing.exposure, timing.stamp)
        if timing.offset_ms is not None:
            return shifted(exposure, round(1000 * timing.offset_ms)), (
                f"frame times were shifted by {timing.offset_ms} ms, as given"
            )
        two_clocks = self._frames is not self._events and survey is not None
        if not two_clocks or timing.clock == "same":
            return exposure, ""
        assert survey is not None and self._events is not None
        if timing.clock != "find" and self._events.triggers is not None:
            triggers = self._events.triggers()
            if len(triggers.t_us):
                pulses = exposures_from_triggers(
                    triggers, len(exposure), channel=timing.trigger_channel, where=self._where
                )
                return pulses, "frames were exposed while the trigger was high"
        if timing.clock == "triggers":
            raise CaptureError("the recording holds no triggers", where=self._where)
        offset = find_offset(
            frames.change, exposure.middle_us, survey.events_per_ms, survey.origin_us
        )
        offset_us = accepted_offset(offset, self._where)
        return shifted(exposure, offset_us), f"frame times were shifted by {offset}"

    def _span(self, survey: Survey | None, exposure: Exposure | None) -> tuple[int, int]:
        """First and last time of the capture."""
        ends = [] if survey is None else [(survey.first_us, survey.last_us)]
        if exposure is not None:
            ends.append((int(exposure.open_us.min()), int(exposure.close_us.max())))
        origin = ends[0][0]
        first, last = min(begin for begin, _ in ends), max(end for _, end in ends)
        crop = self._options.crop
        if crop.start_ms is not None:
            first = max(first, origin + round(1000 * crop.start_ms))
        if crop.end_ms is not None:
            last = min(last, origin + round(1000 * crop.end_ms))
        if last <= first:
            raise OptionError(
                "nothing was recorded in this time range",
                got=f"{crop.start_ms} to {crop.end_ms} ms after the first event",
            )
        return first, last

    def _write_events(
        self, survey: Survey, geometry: CaptureGeometry, span: tuple[int, int]
    ) -> EventFilter:
        """Filter and write the events; returns the filter with its counts."""
        assert self._events is not None and self._events.size is not None
        cleaning = self._options.cleaning
        event_filter = EventFilter(
            hot_pixels(survey.events_per_pixel, cleaning.hot),
            round(1000 * cleaning.isolated_ms),
            span,
            self._events.size,
        )
        if self._stage.events_record.is_file():
            record = json.loads(self._stage.events_record.read_text())
            event_filter.load_counts(record["removed"])
            self._dropped |= record["dropped"]
        else:
            # The colour filter of a separate frame camera is not that of the event sensor.
            unknown = geometry.separate_sensors and self._options.scene.bayer is None
            bayer = "" if unknown else colour_filter(self._events, self._options.scene.bayer)
            chunks = (event_filter.filtered(chunk) for chunk in self._event_chunks(survey.count))
            self._stage.write(
                (geometry.mapped_events(chunk, bayer) for chunk in chunks),
                geometry.mapped_events(empty_stream(self._events.size), bayer),
                span,
            )
            self._log_dropped(self._events)
            record = {"removed": event_filter.counts(), "dropped": self._dropped}
            write_json(self._stage.events_record, record)
        self._stage.join()
        return event_filter

    def _event_chunks(self, count: int) -> Iterator[EventStream]:
        """All events; reports the progress."""
        assert self._events is not None
        done = 0
        for chunk in self._events.chunks():
            yield chunk
            done += len(chunk)
            self._progress("writing events", done, count)

    def _log_dropped(self, recording: Recording) -> None:
        """Keep the counts of what a reader left out; each pass over a recording finds the same."""
        for kind, count in recording.log.counts.items():
            self._dropped[kind] = max(self._dropped.get(kind, 0), count)

    def _crop(
        self, frames: WrittenFrames, exposure: Exposure, span: tuple[int, int]
    ) -> tuple[WrittenFrames, Exposure, dict[str, int]]:
        """Frames with exposures inside the time range and the poses, and counts of the others."""
        inside = (exposure.open_us >= span[0]) & (exposure.close_us <= span[1])
        posed = np.ones(len(exposure), bool)
        if self._options.scene.poses is not None:
            times_us, _ = read_poses(self._options.scene.poses)
            posed = (exposure.open_us >= times_us[0] - POSE_TOLERANCE_US) & (
                exposure.close_us <= times_us[-1] + POSE_TOLERANCE_US
            )
        keep = inside & posed
        if not keep.any():
            raise CaptureError(
                "no frame was exposed within the time of the poses"
                if inside.any()
                else "no frame was exposed in this time range",
                where=self._where,
                got=f"frames from {exposure.open_us.min()} to {exposure.close_us.max()} us",
                do="check that both count from the same instant, and the units",
            )
        for name in np.array(frames.names)[~keep]:
            (self._stage.capture / "frames" / f"{name}.png").unlink(missing_ok=True)
        dropped = {
            "frames outside the time range": int((~inside).sum()),
            "frames without poses": int((inside & ~posed).sum()),
        }
        return (
            frames.selected(keep),
            Exposure(exposure.open_us[keep], exposure.close_us[keep]),
            {kind: count for kind, count in dropped.items() if count},
        )

    def _capture(
        self,
        name: str,
        geometry: CaptureGeometry,
        written: WrittenFrames | None,
        exposure: Exposure | None,
        span: tuple[int, int],
    ) -> Capture:
        clock = Clock(span[0], max(span[1] - span[0], 1))
        scene = self._options.scene
        frames = None
        if written is not None and exposure is not None and self._frames is not None:
            raw = "linear" if colour_filter(self._frames, self._options.scene.bayer) else "gamma2.2"
            blank = np.zeros((), f"uint{written.bits}")
            frames = Frames(
                # Placeholder pixels: the images are on disk already.
                np.broadcast_to(blank, (len(written.names), *written.shape)),
                exposure,
                np.zeros(len(written.names), np.int64),
                written.names,
                scene.encoding or self._frames.frame_encoding or raw,
            )
        events = None if self._events is None else empty_stream(self._events.size or (1, 1))
        return Capture(
            camera=geometry.camera,
            trajectory=self._trajectory(clock),
            clock=clock,
            near=scene.near or NEAR,
            far=scene.far or FAR,
            frames=frames,
            events=events,
            split=Split(np.arange(0 if frames is None else len(frames)), np.zeros(0, np.int64)),
            name=name,
            known=self._known(geometry),
            source=" and ".join(dict.fromkeys(r.layout for r in (self._events, self._frames) if r)),
        )

    def _trajectory(self, clock: Clock) -> Trajectory:
        if self._options.scene.poses is None:
            return Still(np.eye(3, 4)[None])
        times_us, poses = read_poses(self._options.scene.poses)
        return Stamped(times_us, poses, clock)

    def _notes(
        self,
        geometry: CaptureGeometry,
        event_filter: EventFilter | None,
        left_out: dict[str, int],
        clock: str,
    ) -> dict[str, Note]:
        notes: dict[str, Note] = {**geometry.notes}
        if clock:
            notes["clock"] = clock
        if left_out:
            notes["left_out"] = ", ".join(f"{count} {kind}" for kind, count in left_out.items())
        if event_filter is not None and len(event_filter.hot):
            notes["hot_pixels"] = event_filter.hot
        return notes

    def _known(self, geometry: CaptureGeometry) -> Known:
        scene = self._options.scene
        thresholds = None if self._events is None else self._events.thresholds
        return Known(
            poses="unknown" if scene.poses is None else "known",
            intrinsics=geometry.intrinsics,
            bounds="unknown" if None in (scene.near, scene.far) else "known",
            thresholds=Thresholds(*thresholds) if thresholds else None,
        )

    def _finish(self, capture: Capture, frames: WrittenFrames | None) -> None:
        """Write the description, and move the capture to its final path."""
        tables = None
        if frames is not None and capture.frames is not None:
            exposure = capture.frames.exposure
            shutter = zip(frames.names, exposure.open_us, exposure.close_us, strict=True)
            tables = [
                {"name": name, "open_us": int(begin), "close_us": int(end), "use": "train"}
                for name, begin, end in shutter
            ]
        native.describe(capture, self._stage.capture, frames=tables)
        self._stage.finish()
