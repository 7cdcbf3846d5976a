"""Simulated captures of a walk through a room, with measured depth and realistic motion blur.

Frames are evenly spaced and have the same exposure time, which is chosen so that a given fraction
of them is blurred. Which ones are sharp depends on the walk: those in its pauses. Everything is
known: the sharp image and the depth in the middle of each exposure, the pose at any time, and the
true blur of every frame (`Frames.blur_px`, see `cameras.motions.travel`). Held-out frames are
instants, and therefore sharp.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt16

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Note, Split
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.frames import MILLIMETRE, DepthMaps, Exposure, Frames
from sharpfield.core.seed import numpy_generator
from sharpfield.simulation.cameras.motions import (
    CameraPath,
    exposure_for,
    instants,
    stamped,
    travel,
)
from sharpfield.simulation.cameras.rigs import walk
from sharpfield.simulation.scenes.room_scene import room
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.sensors.events import EventPixels, Gap, joined
from sharpfield.simulation.sensors.frames import DepthSensor, Exposing, drifting, store
from sharpfield.simulation.sensors.motion_blur import PUBLISHED, KernelRange, blurred, drawn_blur
from sharpfield.simulation.static_capture import MARGIN_US, Rig, drawn_ahead, view

BLURRY_OF_WIDTH = 0.006
"""Travel from which a frame counts as blurry, as a fraction of the image's width: 1.4 px of 240,
3.8 px of 640."""
STRIDE_PX = 0.8
"""Largest travel between two of the images that are averaged to a blurred frame."""
MOST_IMAGES = 64
PROBE_PX = 24
"""Width of the images in which travel is measured."""
OPEN_OF_INTERVAL = 0.9
"""Longest exposure, as a fraction of the interval between two."""
FARTHEST_M = 65.0
"""Depth that 16 bits of millimetres can hold."""

Blur = Literal["motion", "published"]


@dataclass(frozen=True)
class RoomTiming:
    """Number of frames, their blur, and which are held out."""

    frames: int = 200
    interval_us: int = 100_000
    """From one exposure's start to the next."""
    blurry: float = 0.75
    """Fraction of the training frames that is blurred."""
    blur: Blur = "motion"
    """By the motion during the exposure; or as published, each image by one random kernel."""
    exposure_us: int | None = None
    """None chooses the exposure for that fraction."""
    test_every: int = 8
    """One frame in so many is sharp and held out, the first included; 0 for none."""
    train_every: int = 0
    """Instead: train on one frame in so many, and hold out all others, as published (5)."""
    events: bool = False
    """Whether to simulate an event camera, too; takes several times longer."""
    step_us: int = 4000
    """Time between two images of the event camera."""

    def __post_init__(self) -> None:
        if self.frames < 2 or self.interval_us < 1000 or self.step_us < 1:
            raise OptionError(
                "a walk needs two frames, and an interval of 1000 us",
                got=f"{self.frames} frames, {self.interval_us} us, step {self.step_us} us",
            )
        if not 0 <= self.blurry <= 1:
            raise OptionError("the share of blurry frames lies between 0 and 1", got=self.blurry)
        if self.exposure_us is not None and not 0 <= self.exposure_us <= self.interval_us:
            raise OptionError(
                "exposures would overlap",
                got=f"one of {self.exposure_us} us every {self.interval_us} us",
            )

    @property
    def held_out(self) -> Bool[np.ndarray, "n"]:
        """Which frames are sharp and held out."""
        index = np.arange(self.frames)
        if self.train_every:
            return index % self.train_every != 0
        return (index % self.test_every == 0) if self.test_every else index < 0

    def middle_us(self) -> Int64[np.ndarray, "n"]:
        """Middles of the exposures."""
        return MARGIN_US + self.interval_us // 2 + np.arange(self.frames) * self.interval_us

    def span_us(self) -> int:
        """Length of the recording."""
        return self.frames * self.interval_us + 2 * MARGIN_US


@dataclass(frozen=True)
class RoomSensors:
    """Accuracy of the measured depth and poses; exact by default."""

    depth: DepthSensor = DepthSensor()
    drift: float = 0.0
    """Slow drift of the poses from the true ones, in metres."""


ROOM_RIG, ROOM_TIMING, ROOM_SENSORS = Rig(size=(240, 180)), RoomTiming(), RoomSensors()


def simulate_room(
    *,
    rig: Rig = ROOM_RIG,
    timing: RoomTiming = ROOM_TIMING,
    sensors: RoomSensors = ROOM_SENSORS,
    kernels: KernelRange = PUBLISHED,
    seed: int = 0,
) -> Capture:
    """Record a walk through the room with a depth camera and a global shutter.

    Args:
        rig: Sensors and their numbers.
        timing: Frames, their blur, and which are held out.
        sensors: Accuracy of depth and poses.
        kernels: Ranges of the published blur; its probability is `timing.blurry`.
        seed: Of the walk, the kernels and the noise.

    Returns:
        A capture with measured depth, and the truth and true blur of every frame.
    """
    place, camera, clock = room(), rig.camera(), Clock(0, timing.span_us())
    path = walk(timing.span_us(), seed)
    probe = _Probe(place, camera, path, timing.middle_us())
    exposure = _exposure(probe, camera, timing)
    recorded = _Recorded(exposure, rig, seed, events=timing.events)
    times = _times(probe, exposure, timing).tolist()
    images = drawn_ahead(lambda t: view(place, camera, path.poses(np.array([t]))[0]), times)
    for t_us, (rgb, depth) in zip(times, images, strict=True):
        recorded.see(t_us, rgb, depth)
    frames = recorded.frames()
    blur = np.array([probe.travel(i, exposure.window(i)).mean() for i in range(len(exposure))])
    if timing.blur == "published":
        ranges = replace(kernels, probability=timing.blurry)
        frames, blur = _as_published(frames, timing.held_out, ranges, seed)
    stored = [
        _stored(sensors.depth.measure(depth, camera, numpy_generator(seed, i, "depth noise")))
        for i, depth in enumerate(recorded.depth)
    ]
    return Capture(
        camera=camera,
        trajectory=stamped(drifting(path, sensors.drift, seed), clock),
        clock=clock,
        near=place.near,
        far=place.far,
        frames=replace(frames, blur_px=blur),
        events=recorded.events(),
        split=Split(np.flatnonzero(~timing.held_out), np.flatnonzero(timing.held_out)),
        depth=DepthMaps(np.stack(stored), camera),
        name=place.name,
        source="simulation",
        known=recorded.known(),
        notes=recorded.notes(),
    )


def _stored(depth: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """In millimetres; 0 where they exceed 16 bits."""
    return np.rint(np.where(depth < FARTHEST_M, depth / MILLIMETRE, 0)).astype(np.uint16)


class _Probe:
    """Travel of points during each frame, measured in small images."""

    def __init__(
        self, place: Scene, camera: Camera, path: CameraPath, middle_us: Int64[np.ndarray, "n"]
    ) -> None:
        self._path = path
        self._small = camera.scaled(min(PROBE_PX / camera.width, 1.0))
        self._larger = camera.width / self._small.width
        self._depth = [view(place, self._small, pose)[1] for pose in path.poses(middle_us)]

    def travel(self, frame: int, window_us: tuple[int, int]) -> Float64[np.ndarray, "q"]:
        """In px of the full camera."""
        return self._larger * travel(self._small, self._path, self._depth[frame], window_us)


def _exposure(probe: _Probe, camera: Camera, timing: RoomTiming) -> Exposure:
    """All exposures; those of held-out frames, and of all if blur is as published, are instants."""
    middle = timing.middle_us()
    learned = np.flatnonzero(~timing.held_out).tolist()

    def travels(exposure_us: int) -> Float64[np.ndarray, "n"]:
        opens = middle - exposure_us // 2
        windows = [(int(opens[i]), int(opens[i]) + exposure_us) for i in learned]
        return np.array(
            [probe.travel(i, window).mean() for i, window in zip(learned, windows, strict=True)]
        )

    if timing.blur == "published":
        return Exposure(middle, middle)
    exposure_us = timing.exposure_us
    if exposure_us is None:
        exposure_us = exposure_for(
            travels,
            blurry=timing.blurry,
            blur_px=BLURRY_OF_WIDTH * camera.width,
            most_us=int(OPEN_OF_INTERVAL * timing.interval_us),
        )
    opens = np.where(timing.held_out, middle, middle - exposure_us // 2)
    return Exposure(opens, np.where(timing.held_out, middle, opens + exposure_us))


def _times(probe: _Probe, exposure: Exposure, timing: RoomTiming) -> Int64[np.ndarray, "k"]:
    """Times of the images to render: often enough during exposures, and evenly for events."""
    times = []
    for i in range(len(exposure)):
        far = float(np.quantile(probe.travel(i, exposure.window(i)), 0.95))
        images = min(int(np.ceil(far / STRIDE_PX)) + 1, MOST_IMAGES)
        times.append(instants(exposure, i, images=images))
    if timing.events:
        times.append(np.arange(0, timing.span_us() + 1, timing.step_us))
    return np.unique(np.concatenate(times))


class _Recorded:
    """Frames, one after the other so that only one is held in full precision; and events."""

    def __init__(self, exposure: Exposure, rig: Rig, seed: int, *, events: bool) -> None:
        self._exposure, self._rig, self._seed = exposure, rig, seed
        self._frame = 0
        self._open: Exposing | None = None
        self._images: list[np.ndarray] = []
        self._truth: list[np.ndarray] = []
        self.depth: list[Float32[np.ndarray, "h w"]] = []
        """In the middle of each exposure."""
        self._pixels = EventPixels(rig.event_sensor, seed) if events else None
        self._gaps: list[Gap] = []

    def see(
        self, t_us: int, rgb: Float32[np.ndarray, "h w 3"], depth: Float32[np.ndarray, "h w"]
    ) -> None:
        """An image, after all earlier ones."""
        if self._pixels is not None:
            self._gaps.append(self._pixels.see(rgb, 1000 * t_us))
        i = self._frame
        if i == len(self._exposure) or t_us < self._exposure.open_us[i]:
            return
        if self._open is None:
            one = Exposure(self._exposure.open_us[i : i + 1], self._exposure.close_us[i : i + 1])
            self._open = Exposing(one, self._rig.size)
        self._open.see(rgb, t_us)
        sensor = self._rig.frame_sensor
        draw = numpy_generator(self._seed, i, "frame noise")
        if t_us == self._exposure.middle_us[i]:
            self._truth.append(store(rgb, sensor.noiseless(), draw))
            self.depth.append(depth)
        if t_us == self._exposure.close_us[i]:
            self._images.append(store(self._open.means()[0], sensor, draw))
            self._open, self._frame = None, i + 1

    def frames(self) -> Frames:
        """All frames, each with the sharp image in the middle of its exposure as its truth."""
        count = len(self._exposure)
        return Frames(
            images=np.stack(self._images),
            exposure=self._exposure,
            track=np.zeros(count, np.int64),
            names=tuple(f"{i:04d}" for i in range(count)),
            encoding=self._rig.frame_sensor.encoding,
            truth=np.stack(self._truth),
            truth_known=np.ones(count, bool),
        )

    def events(self) -> EventStream | None:
        """All events, if there is an event camera."""
        if self._pixels is None:
            return None
        return joined(self._gaps, self._rig.size, bayer=self._rig.event_sensor.bayer)

    def known(self) -> Known:
        """What a capture knows about the event camera, if there is one."""
        return Known() if self._pixels is None else self._pixels.known()

    def notes(self) -> dict[str, Note]:
        """Remarks of a capture about the event camera."""
        return {} if self._pixels is None else self._pixels.notes()


def _as_published(
    frames: Frames, held_out: Bool[np.ndarray, "n"], ranges: KernelRange, seed: int
) -> tuple[Frames, Float64[np.ndarray, "n"]]:
    """Training frames blurred by a random kernel each, and the length of each kernel."""
    images, blur = frames.images.copy(), np.zeros(len(frames))
    for i in np.flatnonzero(~held_out):
        drawn = drawn_blur(ranges, numpy_generator(seed, int(i), "kernel"))
        if drawn is not None:
            images[i] = blurred(frames.images[i], drawn.kernel)
            blur[i] = drawn.length_px
    return replace(frames, images=images), blur
