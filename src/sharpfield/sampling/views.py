"""What the steps of a splat recipe look at: whole images at a few instants.

A *look* is the instants whose views a step draws, with what was measured of them: the blurred frame
of an exposure, the sharp images that events make of it, and the *windows*, which are the events
counted at every pixel between two instants that follow each other. A look at a part of the image
costs less.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.measurements import Batch, Depths, EventPairs, Instants, Pixels
from sharpfield.core.seed import number, numpy_generator
from sharpfield.events.counts import counts_between
from sharpfield.events.latent_frames import SensorEstimate, SharpInstants
from sharpfield.events.motion import EventMotion
from sharpfield.events.ramps import phase_at
from sharpfield.ops.permutation import shuffled
from sharpfield.sampling.measured_depth import MeasuredDepth
from sharpfield.storage.event_cache import event_index

ROUNDED = 0.5
"""Events that a count may be off by at an end where the phase of the pixel is unknown."""

Times = Int64[np.ndarray, "_"]


@dataclass(frozen=True)
class SamplingOptions:
    """What a step looks at, and how each part of it counts.

    Where events can make sharp images, *early* steps look at one instant, drawn from the whole
    capture: cheap, and from everywhere. *Late* steps look at one exposure.
    """

    blur: Literal["none", "motion"] = "motion"
    """Frames are taken as sharp, or as the mean of light along the motion of the camera: the
    capture's own, or one learned for each frame where it is not known."""
    instants: int = 3
    """Views of an exposure through which the scene learns."""
    draws: int = 3
    """Views drawn for each of those: light adds up over many, a gradient can do with few."""
    early: float = 0.6
    """Part of the schedule that looks at single instants, if events can make sharp images."""
    still: float = 0.0
    """Part of the schedule that takes frames as if they were sharp: a view instead of several."""
    sharp: float = 0.05
    """Weight of the sharp images from events in late steps; in early ones it is 1. 0 leaves them
    out altogether."""
    windows: float = 0.03
    """Weight of the squared error of the number of events between instants; 0 leaves them out."""
    fading: float = 0.03
    """What is left of `sharp` and `windows` at the end of the schedule, if there are frames; they
    fall while Gaussians settle. Events soon tell what is sharp, but are noisy and late in the dark,
    and no two pixels have the same threshold: in the end, blurred frames are nearer the truth."""
    shortest_us: int = 2_000
    """Least length of a window that begins or ends outside an exposure."""
    longest_us: int = 50_000
    """Most length of a stretch of events."""
    depth: float = 0.0
    """Weight of what a depth camera measured, in late steps."""
    quality: Literal["even", "auto", "images", "events"] = "even"
    """Which frames are looked at more often: none; those that events, or else images, say are
    sharp; those that look sharp; those with few events during the exposure."""
    part: int = 0
    """Side of the square part of the image that a step looks at, in pixels; 0 takes the image."""


@dataclass(frozen=True)
class Part:
    """A part of the image, in pixels."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: Tensor) -> Tensor:
        """That part of `[h, w, ...]`."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


class ViewSampler:
    """Draws looks, each as a function of the seed and the step.

    Args:
        options: What they are made of.
        capture: In the model's space.
        seed: Of the run.
        weights: How often each training frame is drawn; all alike by default.
    """

    def __init__(
        self,
        options: SamplingOptions,
        capture: Capture,
        seed: int,
        weights: Float64[np.ndarray, "n"] | None = None,
    ) -> None:
        self.options, self.capture, self.seed = options, capture, seed
        self.weights = weights
        frames, events = capture.frames, capture.events
        if frames is None and options.windows == 0 or events is None and frames is None:
            raise CaptureError(
                "this recipe learns from frames, and there are none",
                where=capture.name,
                do="train event-splat, which learns from events alone",
            )
        if frames is not None and not len(capture.split.train):
            raise CaptureError(
                "no frame is left to learn from",
                where=capture.name,
                got="all are held out",
                do="hold out fewer, or none (--hold-out none)",
            )
        self.motion = self.sharp = None
        if events is not None and (frames is None or options.windows > 0 or options.sharp > 0):
            self.motion = EventMotion.of(capture)
        self.index = None
        if self.motion is not None and self.motion.channel is None:
            events = self.motion.events
            self.index = None if events.rectified else event_index(events)
        known = capture.known.motion != "unknown"
        if self.motion is not None and frames is not None and options.sharp > 0 and known:
            self.sharp = SharpInstants(capture, self.motion, self.index)
        self.depth = None
        if options.depth > 0 and capture.depth is not None:
            self.depth = MeasuredDepth(capture.depth, capture.camera)

    def instant(self, step: int, sensor_estimate: SensorEstimate) -> Batch:
        """A single view of a sharp image, anywhere between the first and the last exposure."""
        assert self.sharp is not None
        random = numpy_generator(self.seed, step, "look")
        times = random.integers(*self.sharp.span_us, size=1, endpoint=True)
        part, frame = self._part(random), int(self.sharp.order[0])
        return {
            "look": self._instants(times, np.ones(1), frame, part),
            "sharp": self._sharp(times, frame, part, sensor_estimate),
        }

    def exposure(
        self, step: int, *, events: bool, sensor_estimate: SensorEstimate, still: bool = False
    ) -> Batch:
        """Views of one exposure, or only its middle; and with events of an instant beside it."""
        random = numpy_generator(self.seed, step, "look")
        frames, part = self.capture.needed_frames, self._part(random)
        frame = self._frame(step)
        opens, closes = frames.exposure.window(frame)
        moved = self.options.blur == "motion" and opens < closes and not still
        few, draws = (self.options.instants, self.options.draws) if moved else (1, 1)
        times, rest = stratified_times((opens, closes), few, draws, random)
        weight = np.full(few, 1 / few)
        windows = events and self.motion is not None and self.options.windows > 0
        if windows:
            times, weight = self._with_one_beside(times, weight, (opens, closes), random)
        batch: Batch = {
            "look": self._instants(times, weight, frame, part),
            "frames": self._frame_pixels(frame, part),
        }
        if len(rest):
            share = 1 / (few * draws)
            batch["rest"] = self._instants(rest, np.full(len(rest), share), frame, part)
        if self.sharp is not None:
            batch["sharp"] = self._sharp(times, frame, part, sensor_estimate)
        if windows:
            batch["events"] = self._windows(times, part)
        if self.depth is not None:
            middle = np.abs(times - (opens + closes) / 2) + (weight == 0) * (closes - opens + 1)
            batch["depth"] = self._depth(frame, int(np.argmin(middle)), part)
        return batch

    def stretch(self, step: int) -> Batch:
        """A stretch of events of any length, cut into windows."""
        assert self.motion is not None
        random = numpy_generator(self.seed, step, "look")
        t_us = self.motion.events.t_us
        begin, end = int(t_us[0]), int(t_us[-1])
        longest = min(self.options.longest_us, end - begin)
        length = self.options.shortest_us + random.random() * (longest - self.options.shortest_us)
        start = begin + random.random() * max(end - begin - length, 0)
        count = max(self.options.instants, 2)
        times = np.rint(np.linspace(start, start + length, count)).astype(np.int64)
        part = self._part(random)
        return {
            "look": self._instants(times, np.zeros(count), None, part),
            "events": self._windows(times, part),
        }

    def _frame(self, step: int) -> int:
        """Every frame once, in a new order each time; or drawn by quality."""
        train = self.capture.split.train
        if self.weights is not None:
            chance = numpy_generator(self.seed, step, "frames").random()
            return int(train[np.searchsorted(np.cumsum(self.weights), chance * self.weights.sum())])
        epoch, place = divmod(step, len(train))
        drawn = shuffled(
            np.array([place]), len(train), seed=number(self.seed, 0, "frames"), epoch=epoch
        )
        return int(train[drawn[0]])

    def _with_one_beside(
        self,
        times: Times,
        weight: np.ndarray,
        window_us: tuple[int, int],
        random: np.random.Generator,
    ) -> tuple[Times, np.ndarray]:
        """One more instant, before or after the exposure, of no weight in it."""
        assert self.motion is not None
        away = self.options.shortest_us + int(random.random() * self.options.longest_us / 2)
        beside = window_us[0] - away if random.random() < 0.5 else window_us[1] + away
        t_us = self.motion.events.t_us
        beside = int(np.clip(beside, t_us[0], t_us[-1]))
        times, weight = np.append(times, beside), np.append(weight, 0.0)
        order = np.argsort(times, kind="stable")
        return times[order], weight[order]

    def _part(self, random: np.random.Generator) -> Part:
        width, height = self.capture.camera.size
        side = self.options.part
        if side == 0 or side >= max(width, height):
            return Part(0, 0, width, height)
        wide, high = min(side, width), min(side, height)
        left = int(random.integers(width - wide, endpoint=True))
        return Part(left, int(random.integers(height - high, endpoint=True)), wide, high)

    def _instants(
        self, times: Times, weight: np.ndarray, frame: int | None, part: Part
    ) -> Instants:
        track = 0 if frame is None else int(self.capture.needed_frames.track[frame])
        time = torch.from_numpy(self.capture.clock.unit(times)).float()[None]
        corner = torch.tensor([part.left, part.top]).expand(1, len(times), 2)
        return Instants(
            time=time,
            track=torch.full((1, len(times)), track),
            weight=torch.from_numpy(weight).float()[None],
            corner=corner,
            size=(part.width, part.height),
        )

    def _frame_pixels(self, frame: int, part: Part) -> Pixels:
        """The blurred frame `[1, h, w]`."""
        frames = self.capture.needed_frames
        image = part.of(torch.from_numpy(np.array(frames.images[frame])))
        opens, closes = self.capture.frame_time[frame]
        return self._pixels(
            (image.to(torch.float32) / frames.white)[None], frame, (opens, closes), part
        )

    def _depth(self, frame: int, instant: int, part: Part) -> Depths:
        """What was measured `[1, h, w]`, and at which of the instants."""
        assert self.depth is not None
        depth = part.of(torch.from_numpy(self.depth.at(frame)))
        return Depths(depth[None], torch.full((), instant).expand(1, *depth.shape))

    def _sharp(
        self, times: Times, frame: int, part: Part, sensor_estimate: SensorEstimate
    ) -> Pixels:
        """Sharp images `[1, h, w, k]` at some instants."""
        assert self.sharp is not None
        value = torch.stack([part.of(self.sharp.at(int(t), sensor_estimate)) for t in times], 2)[
            None
        ]
        time = torch.from_numpy(self.capture.clock.unit(times)).float()
        return self._pixels(value, frame, (time, time), part)

    def _pixels(
        self, value: Tensor, frame: int, window: tuple[Tensor, Tensor], part: Part
    ) -> Pixels:
        shape = value.shape[:-1]
        xy = part.of(self.capture.camera.grid())
        xy = xy[None, :, :, None] if len(shape) == 4 else xy[None]
        track = int(self.capture.needed_frames.track[frame])
        return Pixels(
            xy=xy.expand(*shape, 2),
            frame=torch.full((), frame).expand(shape),
            track=torch.full((), track).expand(shape),
            open=window[0].expand(shape),
            close=window[1].expand(shape),
            value=value,
        )

    def _windows(self, times: Times, part: Part) -> EventPairs:
        """Events at every pixel between instants, `[1, k - 1, h, w, c]`.

        On a colour sensor every pixel has one measurement for each of c = 3 colours, interpolated
        from the pixels that see it.
        """
        assert self.motion is not None
        counted = [
            counts_between(self.motion, int(start), int(end))
            for start, end in zip(times[:-1], times[1:], strict=True)
        ]
        negative = torch.stack([part.of(darker) for darker, _ in counted])[None]
        positive = torch.stack([part.of(brighter) for _, brighter in counted])[None]
        slack = ((negative == 0) & (positive == 0)).float()
        if self.index is not None:
            size = {"width": self.motion.events.width, "height": self.motion.events.height}
            found = [phase_at(self.index, int(time), **size) for time in times]
            phase = torch.stack([part.of(phase) for phase, _ in found])[None, ..., None]
            unknown = torch.stack([~part.of(known) for _, known in found])[None, ..., None]
            negative = negative + phase[:, 1:].clamp_max(0) - phase[:, :-1].clamp_max(0)
            positive = positive + phase[:, 1:].clamp_min(0) - phase[:, :-1].clamp_min(0)
            slack = ROUNDED * (unknown[:, 1:].float() + unknown[:, :-1].float())
        shape = negative.shape
        time = torch.from_numpy(self.capture.clock.unit(times)).float()[:, None, None, None]
        xy = part.of(self.capture.camera.grid())[:, :, None]
        return EventPairs(
            xy=xy.expand(*shape, 2),
            track=torch.zeros((), dtype=torch.int64).expand(shape),
            start=time[:-1].expand(shape),
            end=time[1:].expand(shape),
            negative=negative,
            positive=positive,
            channel=torch.arange(3).expand(shape) if shape[-1] == 3 else None,
            slack=slack,
        )


def stratified_times(
    window_us: tuple[int, int], few: int, draws: int, random: np.random.Generator
) -> tuple[Times, Times]:
    """Instants spread evenly over an exposure: `few` that teach, and the rest of `few * draws`."""
    opens, closes = window_us
    count = few * draws
    place = (np.arange(count) + (random.random(count) if count > 1 else 0.5)) / count
    times = np.rint(opens + (closes - opens) * place).astype(np.int64)
    chosen = np.arange(few) * draws + random.integers(draws, size=few)
    return times[chosen], np.delete(times, chosen)
