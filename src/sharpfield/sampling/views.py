"""View sampling for recipes on Gaussians: whole views of one or several cameras at a few instants.

A batch holds the *instants* whose views a step renders, for each of its cameras, and what was
measured of them: the blurred frame of an exposure, *latent frames* (sharp images by the event
double integral), and *windows*: the events counted at every pixel from one instant to the next.
All cameras of a batch share its instants, so that moving Gaussians are evaluated once for all.
A *crop* of the image makes a step cheaper.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.measurements import Batch
from sharpfield.core.seed import number, numpy_generator, shuffled
from sharpfield.events.latent_frames import LatentFrames, SensorEstimate
from sharpfield.sampling.event_windows import Times, camera_events
from sharpfield.sampling.view_measurements import Crop, Tracks, ViewMeasurements


@dataclass(frozen=True)
class SamplingOptions:
    """Which views a step renders, and how much each kind of measurement counts.

    Where events give latent frames, steps of the *EDI phase* render one instant of the whole
    capture: cheap, and from everywhere. Later steps render one exposure.
    """

    blur: Literal["none", "motion"] = "motion"
    """`none` takes frames as sharp; `motion` as the mean of light along the motion of the camera:
    the capture's own, or one learned for each frame where it is not known."""
    cameras: int = 1
    """Maximum number of cameras in one step; all at the same instants."""
    views: int = 9
    """Views over an exposure whose mean is compared with the blurred frame; rounded up to a
    multiple of `grad_views`."""
    grad_views: int = 3
    """How many of them the scene learns through; the others are rendered without gradient. Also
    the views of a batch of events alone."""
    edi_phase: float = 0.6
    """Fraction of the schedule that compares latent frames at single instants, where events give
    them."""
    sharp_warmup: float = 0.0
    """Fraction of the schedule that takes frames as sharp: one view instead of several."""
    latent_weight: float = 0.05
    """Weight of latent frames beside a blurred frame; alone it is 1. 0 makes none."""
    latent_pairs: bool = False
    """Where all frames are sharp: after the EDI phase, compare latent frames at two instants and
    the events between them instead of frames. Shows all times of a moving scene."""
    event_weight: float = 0.03
    """Weight of the squared error of the number of events in windows; 0 leaves them out."""
    event_only_weight: float | None = None
    """The same for a capture without frames; None takes `event_weight`."""
    final_event_weight: float = 0.03
    """Factor on `latent_weight` and `event_weight` at the end of the schedule, if there are blurred
    frames; it falls from 1 after growth has ended. Events soon tell what is sharp, but are noisy
    and late in the dark, and no two pixels have the same threshold: in the end, blurred frames are
    nearer the truth."""
    min_window_us: int = 2_000
    """Shortest window that begins or ends outside an exposure, in us."""
    max_window_us: int = 50_000
    """Longest time that the windows of a batch of events alone span, in us."""
    depth_weight: float = 0.0
    """Weight of measured depth, after the EDI phase."""
    frame_quality: Literal["even", "auto", "images", "events"] = "even"
    """Which frames are sampled more often: none; those that events, or else images, show to be
    sharp; those that look sharp; those with few events during the exposure."""
    crop: int = 0
    """Side of the square crop of the image that a step renders, in pixels; 0 takes the image."""

    def events_weight(self, capture: Capture) -> float:
        """The weight of windows of events on a capture, with or without frames."""
        if capture.frames is None and self.event_only_weight is not None:
            return self.event_only_weight
        return self.event_weight


class ViewSampler:
    """Draws the batch of a step as a function of the seed and the step.

    Args:
        options: What batches are made of.
        capture: In the model's space; events of a rolling shutter on the clock of its first row.
        seed: Of the run.
        steps: Length of the schedule.
        weights: How often each training frame is sampled; by default, all equally.
        separate_events: Events get steps of their own beside frames. Needed where their clock may
            be late by an unknown time, which views at the frames' instants cannot tell.
    """

    def __init__(
        self,
        options: SamplingOptions,
        capture: Capture,
        seed: int,
        *,
        steps: int,
        weights: Float64[np.ndarray, "n"] | None = None,
        separate_events: bool = False,
    ) -> None:
        self.options, self.capture, self.seed, self.weights = options, capture, seed, weights
        _check(options, capture)
        frames = capture.frames
        counted = options.events_weight(capture) > 0
        self.cameras = {}
        if capture.events is not None and (counted or options.latent_weight > 0):
            self.cameras = camera_events(capture, latent=options.latent_weight > 0)
        with_frames = [] if frames is None else np.unique(frames.track[capture.split.train])
        both = all(int(track) in self.cameras for track in with_frames)
        self.latent: dict[int, LatentFrames] = {}
        if both:
            self.latent = {t: own.latent for t, own in self.cameras.items() if own.latent}
        self.edi_until = int(options.edi_phase * steps) if self.latent else 0
        self.sharp_until = int(options.sharp_warmup * steps)
        self.counted = bool(self.cameras) and counted
        self.joint_events = self.counted and both and not separate_events
        self.separate_events = self.counted and not self.joint_events
        sharp = frames is not None and bool(frames.exposure.instant[capture.split.train].all())
        self.pairs = options.latent_pairs and sharp and bool(self.latent) and self.joint_events
        self.depth = options.depth_weight > 0 and capture.depth is not None
        self.measured = ViewMeasurements(capture, self.cameras)

    def draw(self, step: int, sensor: SensorEstimate) -> Batch:
        """The batch of a step.

        Args:
            step: Of the schedule.
            sensor: What is known of the event camera by now; latent frames are made with it.
        """
        if step < self.edi_until:
            return self.latent_frame_batch(step, sensor)
        if self.capture.frames is None or (self.separate_events and step % 2):
            return self.event_batch(step)
        if self.pairs:
            return self.latent_pair_batch(step, sensor)
        sharp = step < self.sharp_until
        return self.exposure_batch(
            step, sensor, sharp=sharp, events=self.joint_events and not sharp
        )

    def latent_frame_batch(self, step: int, sensor: SensorEstimate) -> Batch:
        """A latent frame of each camera at one instant between the first and last exposure."""
        random = numpy_generator(self.seed, step, "look")
        tracks = self._choose(random, np.array(list(self.latent)), self.options.cameras)
        times = random.integers(*self._latent_span_us(tracks), size=1, endpoint=True)
        crop = self._crop(random)
        return {
            "views": self.measured.instants(times, np.ones(1), tracks, crop),
            "latent_frames": self.measured.latent_frames(times, tracks, crop, sensor),
        }

    def latent_pair_batch(self, step: int, sensor: SensorEstimate) -> Batch:
        """Latent frames of each camera at two instants, and the events between them."""
        random = numpy_generator(self.seed, step, "look")
        tracks = self._choose(random, np.array(list(self.latent)), self.options.cameras)
        times = self._window_times(random, self._latent_span_us(tracks), 2)
        crop = self._crop(random)
        return {
            "views": self.measured.instants(times, np.ones(2), tracks, crop),
            "latent_frames": self.measured.latent_frames(times, tracks, crop, sensor),
            "events": self.measured.windows(times, tracks, crop),
        }

    def exposure_batch(
        self, step: int, sensor: SensorEstimate, *, events: bool, sharp: bool = False
    ) -> Batch:
        """Frames of one exposure; with the events to an instant beside it.

        Args:
            step: Of the schedule.
            sensor: See `draw`.
            events: Whether to count the events between instants, too, if there are any.
            sharp: Take the frames as sharp: one view in the middle of the exposure.
        """
        random = numpy_generator(self.seed, step, "look")
        crop, frames = self._crop(random), self._frames(step, random)
        tracks = self.capture.needed_frames.track[frames]
        window_us = opens, closes = self.capture.needed_frames.exposure.window(int(frames[0]))
        moved = self.options.blur == "motion" and opens < closes and not sharp
        grad, views = (self.options.grad_views, self.options.views) if moved else (1, 1)
        times, others = stratified_times(window_us, random, grad_views=grad, views=views)
        weight = np.full(grad, 1 / grad)
        if events := events and self.counted:
            times, weight = self._with_outside(times, weight, window_us, random)
        batch: Batch = {
            "views": self.measured.instants(times, weight, tracks, crop),
            "frames": self.measured.frames(frames, crop),
        }
        if len(others):
            share = np.full(len(others), 1 / (grad + len(others)))
            batch["no_grad_views"] = self.measured.instants(others, share, tracks, crop)
        if self.latent:
            batch["latent_frames"] = self.measured.latent_frames(
                times, tracks, crop, sensor, frames
            )
        if events:
            batch["events"] = self.measured.windows(times, tracks, crop)
        if self.depth:
            from_middle = np.abs(times - (opens + closes) / 2)
            nearest = int(np.argmin(from_middle + (weight == 0) * (closes - opens + 1)))
            batch["depth"] = self.measured.depth(frames, nearest, crop)
        return batch

    def event_batch(self, step: int) -> Batch:
        """Events of each camera over a time of any length, cut into windows."""
        random = numpy_generator(self.seed, step, "look")
        t_us = self.capture.needed_events.t_us
        tracks = self._choose(random, np.array(list(self.cameras)), self.options.cameras)
        span_us, count = (int(t_us[0]), int(t_us[-1])), max(self.options.grad_views, 2)
        times = self._window_times(random, span_us, count)
        crop = self._crop(random)
        return {
            "views": self.measured.instants(times, np.zeros(count), tracks, crop),
            "events": self.measured.windows(times, tracks, crop),
        }

    def _frames(self, step: int, random: np.random.Generator) -> Int64[np.ndarray, "m"]:
        """A frame, and those of other cameras with the same exposure.

        Every frame comes once before any comes twice, in a new order each time; or more often the
        higher its quality is.
        """
        train, exposure = self.capture.split.train, self.capture.needed_frames.exposure
        if self.weights is not None:
            chance = numpy_generator(self.seed, step, "frames").random()
            row = np.searchsorted(np.cumsum(self.weights), chance * self.weights.sum())
        else:
            epoch, position = divmod(step, len(train))
            order = number(self.seed, 0, "frames")
            row = shuffled(np.array([position]), len(train), seed=order, epoch=epoch)[0]
        first = int(train[row])
        if self.options.cameras == 1:
            return np.array([first])
        opens, closes = exposure.window(first)
        same = train[(exposure.open_us[train] == opens) & (exposure.close_us[train] == closes)]
        others = self._choose(random, same[same != first], self.options.cameras - 1)
        return np.concatenate([[first], others])

    def _choose(
        self, random: np.random.Generator, among: Int64[np.ndarray, "n"], most: int
    ) -> Int64[np.ndarray, "m"]:
        return random.permutation(among)[:most] if len(among) > 1 else among[:most]

    def _latent_span_us(self, tracks: Tracks) -> tuple[int, int]:
        """From when until when all of some cameras have latent frames."""
        spans = np.array([self.latent[int(track)].span_us for track in tracks])
        first = int(spans[:, 0].max())
        return first, max(int(spans[:, 1].min()), first)

    def _window_times(
        self, random: np.random.Generator, span_us: tuple[int, int], count: int
    ) -> Times:
        """Instants evenly over a time of random length."""
        begin, end = span_us
        longest = min(self.options.max_window_us, end - begin)
        shortest = min(self.options.min_window_us, longest)
        length = shortest + random.random() * (longest - shortest)
        start = begin + random.random() * max(end - begin - length, 0)
        return np.rint(np.linspace(start, start + length, count)).astype(np.int64)

    def _with_outside(
        self,
        times: Times,
        weight: Float64[np.ndarray, "k"],
        window_us: tuple[int, int],
        random: np.random.Generator,
    ) -> tuple[Times, Float64[np.ndarray, "l"]]:
        """One more instant, before or after the exposure, with no weight in its mean."""
        away = self.options.min_window_us + int(random.random() * self.options.max_window_us / 2)
        outside = window_us[0] - away if random.random() < 0.5 else window_us[1] + away
        t_us = self.capture.needed_events.t_us
        outside = int(np.clip(outside, t_us[0], t_us[-1]))
        times, weight = np.append(times, outside), np.append(weight, 0.0)
        order = np.argsort(times, kind="stable")
        return times[order], weight[order]

    def _crop(self, random: np.random.Generator) -> Crop:
        width, height = self.capture.camera.size
        side = self.options.crop
        if side == 0 or side >= max(width, height):
            return Crop(0, 0, width, height)
        wide, high = min(side, width), min(side, height)
        left = int(random.integers(width - wide, endpoint=True))
        return Crop(left, int(random.integers(height - high, endpoint=True)), wide, high)


def stratified_times(
    window_us: tuple[int, int], random: np.random.Generator, *, grad_views: int, views: int
) -> tuple[Times, Times]:
    """Times over an exposure, one in each of equal parts; those with gradient, and the others.

    Args:
        window_us: When the shutter opens and closes.
        random: Moves each time within its part, and chooses.
        grad_views: How many times are for views with gradient: one in each of so many groups.
        views: How many times in all, rounded up to a multiple of `grad_views`.
    """
    opens, closes = window_us
    group = -(-views // grad_views)
    count = grad_views * group
    place = (np.arange(count) + (random.random(count) if count > 1 else 0.5)) / count
    times = np.rint(opens + (closes - opens) * place).astype(np.int64)
    chosen = np.arange(grad_views) * group + random.integers(group, size=grad_views)
    return times[chosen], np.delete(times, chosen)


def _check(options: SamplingOptions, capture: Capture) -> None:
    frames = capture.frames
    if frames is None and options.events_weight(capture) == 0:
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
