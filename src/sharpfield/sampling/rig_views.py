"""What the steps of a moving scene look at: the same moments, seen by several cameras.

A *rig* is all cameras of a capture, each on a track of its own. A *look* is a few instants, the
same for all cameras it takes: the frames of one moment, the sharp images that events carry to
any instant, and the events that each pixel counts between two instants.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.measurements import Batch, EventPairs, Instants, Pixels
from sharpfield.core.seed import numpy_generator
from sharpfield.events.counts import counts_between
from sharpfield.events.index import EventIndex
from sharpfield.events.latent_frames import SensorEstimate, SharpInstants
from sharpfield.events.motion import EventMotion
from sharpfield.events.ramps import phase_at
from sharpfield.sampling.views import ROUNDED, stratified_times
from sharpfield.storage.event_cache import event_index

Times = Int64[np.ndarray, "_"]


@dataclass(frozen=True)
class RigSamplingOptions:
    """What a step looks at, and how each part of it counts."""

    cameras: int = 2
    """Most cameras of a step."""
    instants: int = 3
    """Views of an exposure through which the scene learns, and of a stretch of events."""
    draws: int = 3
    """Views drawn for each of those of an exposure."""
    early: float = 0.7
    """Part of the schedule that looks at single instants, if events can make sharp images."""
    sharp: float = 0.05
    """Weight of the sharp images from events beside a blurred frame; alone it is 1. 0 leaves them
    out altogether."""
    windows: float = 0.03
    """Weight of the squared error of the number of events between instants; 0 leaves them out."""
    alone: float = 0.1
    """The same weight where there are no frames."""
    fading: float = 0.03
    """What is left of `sharp` and `windows` beside blurred frames at the end of the schedule."""
    shortest_us: int = 2_000
    """Least length of a window that begins or ends outside an exposure."""
    longest_us: int = 50_000
    """Most length of a stretch of events."""
    still: float = 0.15
    """Part of the schedule in which what stands still learns alone, if there are frames."""


@dataclass(frozen=True)
class CameraStreams:
    """What one camera of the rig recorded."""

    motion: EventMotion | None
    index: EventIndex | None
    sharp: SharpInstants | None


class RigViewSampler:
    """Draws looks, each as a function of the seed and the step.

    Args:
        options: What they are made of.
        capture: In the model's space.
        seed: Of the run.
        steps: Length of the schedule.
        offset: Whether events may be late by an unknown time; views of the frames' instants cannot
            tell, so that events then have steps of their own.
    """

    def __init__(
        self, options: RigSamplingOptions, capture: Capture, seed: int, *, steps: int, offset: bool
    ) -> None:
        self.options, self.capture, self.seed = options, capture, seed
        frames, events = capture.frames, capture.events
        if frames is None and options.alone == 0:
            raise CaptureError("nothing is left to learn from", where=capture.name)
        if frames is not None and not len(capture.split.train):
            raise CaptureError(
                "no frame is left to learn from", where=capture.name, got="all are held out"
            )
        self.camera_streams = {} if events is None else _seats(capture, options.sharp > 0)
        self.shown = np.zeros(0, np.int64)  # tracks with frames to learn from
        if frames is not None:
            self.shown = np.unique(frames.track[capture.split.train])
        both = all(int(track) in self.camera_streams for track in self.shown)
        images = [t for t, seat in self.camera_streams.items() if seat.sharp is not None]
        self.sharp = images if both else []
        self.late_from = int(options.early * steps) if self.sharp else 0
        counted = bool(self.camera_streams) and options.windows > 0
        self.together = counted and both and not offset
        self.apart = counted and not self.together
        still = frames is not None and bool(frames.exposure.instant.all())
        self.imaged = self.together and still and bool(self.sharp)

    def draw(self, step: int, sensor_estimate: SensorEstimate) -> Batch:
        """One instant in early steps; in late ones an exposure, or a stretch of events."""
        random = numpy_generator(self.seed, step, "look")
        if step < self.late_from:
            return self._instant(random, sensor_estimate)
        if self.capture.frames is None or (self.apart and step % 2):
            return self._stretch(random)
        if self.imaged:
            return self._change(random, sensor_estimate)
        return self._exposure(random, sensor_estimate)

    def _instant(self, random: np.random.Generator, sensor_estimate: SensorEstimate) -> Batch:
        """A sharp image of each of several cameras, at one instant."""
        tracks = self._cameras(random, np.array(self.sharp))
        times = random.integers(*self._span_us(tracks), size=1, endpoint=True)
        return {
            "look": self._instants(times, np.ones(1), tracks),
            "sharp": self._sharp(times, tracks, sensor_estimate),
        }

    def _change(self, random: np.random.Generator, sensor_estimate: SensorEstimate) -> Batch:
        """Sharp images of several cameras at two instants, and the events between them."""
        tracks = self._cameras(random, np.array(self.sharp))
        times = self._within(random, self._span_us(tracks), 2)
        return {
            "look": self._instants(times, np.ones(2), tracks),
            "sharp": self._sharp(times, tracks, sensor_estimate),
            "events": self._windows(times, tracks),
        }

    def _exposure(self, random: np.random.Generator, sensor_estimate: SensorEstimate) -> Batch:
        """Frames of one moment; with events of an instant beside it."""
        options, frames = self.options, self.capture.needed_frames
        train, exposure = self.capture.split.train, self.capture.needed_frames.exposure
        chosen = int(random.choice(train))
        opens, closes = exposure.window(chosen)
        alike = train[(exposure.open_us[train] == opens) & (exposure.close_us[train] == closes)]
        others = self._cameras(random, alike[alike != chosen], options.cameras - 1)
        group = np.concatenate([[chosen], others])
        tracks = frames.track[group]
        few, draws = (options.instants, options.draws) if opens < closes else (1, 1)
        times, rest = stratified_times((opens, closes), few, draws, random)
        weight = np.full(few, 1 / few)
        if self.together:
            times, weight = self._with_one_beside(random, times, weight, (opens, closes))
        batch: Batch = {
            "look": self._instants(times, weight, tracks),
            "frames": self._frames(group),
        }
        if len(rest):
            share = np.full(len(rest), 1 / (few * draws))
            batch["rest"] = self._instants(rest, share, tracks)
        if self.sharp and opens < closes:
            batch["sharp"] = self._sharp(times, tracks, sensor_estimate)
        if self.together:
            batch["events"] = self._windows(times, tracks)
        return batch

    def _stretch(self, random: np.random.Generator) -> Batch:
        """A stretch of events of any length, cut into windows."""
        tracks = self._cameras(random, np.array(list(self.camera_streams)))
        t_us = self.capture.needed_events.t_us
        span_us = int(t_us[0]), int(t_us[-1])
        times = self._within(random, span_us, max(self.options.instants, 2))
        return {
            "look": self._instants(times, np.zeros(len(times)), tracks),
            "events": self._windows(times, tracks),
        }

    def _within(self, random: np.random.Generator, span_us: tuple[int, int], count: int) -> Times:
        """Instants spread evenly over a stretch of any length."""
        begin, end = span_us
        longest = max(min(self.options.longest_us, end - begin), 1)
        shortest = min(self.options.shortest_us, longest)
        length = shortest * (longest / shortest) ** random.random()
        start = begin + random.random() * max(end - begin - length, 0)
        return np.rint(np.linspace(start, start + length, count)).astype(np.int64)

    def _span_us(self, tracks: np.ndarray) -> tuple[int, int]:
        """From when until when all of some cameras have sharp images."""
        spans = np.array([self._images(t).span_us for t in tracks.tolist()])
        first = int(spans[:, 0].max())
        return first, max(int(spans[:, 1].min()), first)

    def _cameras(
        self, random: np.random.Generator, among: np.ndarray, most: int | None = None
    ) -> np.ndarray:
        most = self.options.cameras if most is None else most
        return random.permutation(among)[: max(most, 0)]

    def _images(self, track: int) -> SharpInstants:
        found = self.camera_streams[track].sharp
        assert found is not None
        return found

    def _with_one_beside(
        self,
        random: np.random.Generator,
        times: Times,
        weight: np.ndarray,
        window_us: tuple[int, int],
    ) -> tuple[Times, np.ndarray]:
        """One more instant, before or after the exposure, of no weight in it."""
        options = self.options
        away = options.shortest_us + int(random.random() * options.longest_us)
        beside = window_us[0] - away if random.random() < 0.5 else window_us[1] + away
        t_us = self.capture.needed_events.t_us
        beside = int(np.clip(beside, t_us[0], t_us[-1]))
        times, weight = np.append(times, beside), np.append(weight, 0.0)
        order = np.argsort(times, kind="stable")
        return times[order], weight[order]

    def _instants(self, times: Times, weight: np.ndarray, tracks: np.ndarray) -> Instants:
        shape = len(tracks), len(times)
        time = torch.from_numpy(self.capture.clock.unit(times)).float()
        return Instants(
            time=time.expand(shape),
            track=torch.from_numpy(np.asarray(tracks, np.int64))[:, None].expand(shape),
            weight=torch.from_numpy(weight).float().expand(shape),
            corner=torch.zeros(*shape, 2, dtype=torch.int64),
            size=self.capture.camera.size,
        )

    def _frames(self, group: np.ndarray) -> Pixels:
        """Blurred frames `[m, h, w]`."""
        frames = self.capture.needed_frames
        value = torch.from_numpy(frames.images[group].astype(np.float32)) / frames.white
        when = self.capture.frame_time[torch.from_numpy(group)]
        return self._pixels(value, frames.track[group], group, (when[:, 0], when[:, 1]))

    def _sharp(self, times: Times, tracks: np.ndarray, sensor_estimate: SensorEstimate) -> Pixels:
        """Sharp images `[m, h, w, k]` at some instants."""
        value = torch.stack(
            [
                torch.stack([self._images(t).at(int(at), sensor_estimate) for at in times], 2)
                for t in tracks.tolist()
            ]
        )
        time = torch.from_numpy(self.capture.clock.unit(times)).float()
        return self._pixels(value, tracks, np.zeros(len(tracks), np.int64), (time, time))

    def _pixels(
        self,
        value: Tensor,
        tracks: np.ndarray,
        frames: np.ndarray,
        when: tuple[Tensor, Tensor],
    ) -> Pixels:
        shape = value.shape[:-1]
        rest = [1] * (len(shape) - 1)
        xy = self.capture.camera.grid()
        xy = xy[:, :, None] if len(shape) == 4 else xy

        def spread(values: Tensor) -> Tensor:
            """Of each camera, or of each instant, to all pixels."""
            return (values if len(shape) == 4 else values.view(-1, *rest)).expand(shape)

        return Pixels(
            xy=xy.expand(*shape, 2),
            frame=torch.from_numpy(frames).view(-1, *rest).expand(shape),
            track=torch.from_numpy(np.asarray(tracks, np.int64)).view(-1, *rest).expand(shape),
            open=spread(when[0]),
            close=spread(when[1]),
            value=value,
        )

    def _windows(self, times: Times, tracks: np.ndarray) -> EventPairs:
        """Events at every pixel between instants, `[m, k - 1, h, w, 1]`."""
        found = [
            _counted(self.camera_streams[track], times, self.capture) for track in tracks.tolist()
        ]
        negative, positive, slack = (torch.stack(part) for part in zip(*found, strict=True))
        shape = negative.shape
        time = torch.from_numpy(self.capture.clock.unit(times)).float()[:, None, None, None]
        track = torch.from_numpy(np.asarray(tracks, np.int64)).view(-1, 1, 1, 1, 1)
        return EventPairs(
            xy=self.capture.camera.grid()[:, :, None].expand(*shape, 2),
            track=track.expand(shape),
            start=time[:-1].expand(shape),
            end=time[1:].expand(shape),
            negative=negative,
            positive=positive,
            slack=slack,
        )


def _counted(seat: CameraStreams, times: Times, capture: Capture) -> tuple[Tensor, Tensor, Tensor]:
    """Events to darker and to brighter, and their slack, of one camera `[k - 1, h, w, 1]`."""
    assert seat.motion is not None and seat.index is not None
    counted = [
        counts_between(seat.motion, int(start), int(end))
        for start, end in zip(times[:-1], times[1:], strict=True)
    ]
    negative, positive = (torch.stack(part) for part in zip(*counted, strict=True))
    width, height = capture.camera.size
    found = [phase_at(seat.index, int(time), width=width, height=height) for time in times]
    phase = torch.stack([phase for phase, _ in found])[..., None]
    unknown = torch.stack([~known for _, known in found])[..., None].float()
    negative = negative + phase[1:].clamp_max(0) - phase[:-1].clamp_max(0)
    positive = positive + phase[1:].clamp_min(0) - phase[:-1].clamp_min(0)
    return negative, positive, ROUNDED * (unknown[1:] + unknown[:-1])


def _seats(capture: Capture, sharp: bool) -> dict[int, CameraStreams]:
    """What each camera recorded that has events; with sharp images where it has frames, too.

    Raises:
        CaptureError: Events have colours or are rectified.
    """
    events = capture.needed_events
    if events.coloured or events.rectified:
        raise CaptureError(
            "moving Gaussians need events that name pixels of grey sensors",
            where=capture.name,
            got="colour filters" if events.coloured else "rectified positions",
            do="train evdnerf-physical, which knows neither as images; or --use frames",
        )
    camera_streams = {}
    for track in range(events.tracks):
        own = events.of_track(track)
        if not len(own):
            continue
        alone = replace(capture, events=replace(own, track=None, tracks=1))
        motion = EventMotion.of(alone)
        index = event_index(motion.events)
        mine = _frames_of(alone, track)
        found = None if mine is None or not sharp else SharpInstants(mine, motion, index)
        camera_streams[track] = CameraStreams(motion, index, found)
    return camera_streams


def _frames_of(capture: Capture, track: int) -> Capture | None:
    """The capture with the training frames of one camera alone; None if it has none."""
    if capture.frames is None:
        return None
    frames, train = capture.frames, capture.split.train
    own = train[frames.track[train] == track]
    if not len(own):
        return None
    exposure = Exposure(frames.exposure.open_us[own], frames.exposure.close_us[own])
    part = Frames(
        frames.images[own],
        exposure,
        frames.track[own],
        tuple(frames.names[i] for i in own),
        frames.encoding,
    )
    split = Split(np.arange(len(own)), np.zeros(0, np.int64))
    return replace(capture, frames=part, depth=None, split=split)
