"""Simulated captures of static scenes: blurry frames, events, poses and sharp truth on one clock.

Frames follow the published Ev-DeblurNeRF data: one exposure every interval, blurred by the
camera's motion, but every eighth a sharp view at the middle of its slot, held out for testing. The
frame camera and the event camera share pose and lens.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import ceil
from os import cpu_count
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Note, Split
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.seed import numpy_generator
from sharpfield.simulation.cameras.motions import CameraPath, motion, stamped
from sharpfield.simulation.scenes.static import Scene, scene
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.events import EventPixels, Gap, joined, watch
from sharpfield.simulation.sensors.frames import Exposing, FrameSensor, store


class Recorder:
    """Blurry frames, their sharp truth, and events, from a sequence of images."""

    def __init__(
        self,
        size: tuple[int, int],
        exposure: Exposure,
        *,
        frame_sensor: FrameSensor,
        event_sensor: EventSensor,
        seed: int,
    ) -> None:
        delay = frame_sensor.row_delay_us
        middle = Exposure(exposure.middle_us, exposure.middle_us)
        self._size, self._seed = size, seed
        self._exposure = replace(exposure, row_delay_us=delay)
        self._blurry = Exposing(exposure, size, row_delay_us=delay)
        self._sharp = Exposing(middle, size, row_delay_us=delay)
        self._frame_sensor, self._event_sensor = frame_sensor, event_sensor
        self._pixels = EventPixels(event_sensor, seed)
        self._gaps: list[Gap] = []

    def see(self, rgb: Float32[np.ndarray, "h w 3"], t_us: int) -> None:
        """Linear light at an instant, after all earlier ones."""
        self._gaps.append(self._pixels.see(rgb, 1000 * t_us))
        self._blurry.see(rgb, t_us)
        self._sharp.see(rgb, t_us)

    def frames(self) -> Frames:
        """All frames, each with the sharp image at the middle of its exposure as its truth."""
        count, draw = len(self._exposure), numpy_generator(self._seed, 0, "frame noise")
        return Frames(
            images=store(self._blurry.means(), self._frame_sensor, draw),
            exposure=self._exposure,
            track=np.zeros(count, np.int64),
            names=tuple(f"{i:04d}" for i in range(count)),
            encoding=self._frame_sensor.encoding,
            truth=store(self._sharp.means(), self._frame_sensor.noiseless(), draw),
            truth_known=np.ones(count, bool),
        )

    def events(self) -> EventStream:
        """All events."""
        return joined(self._gaps, self._size, bayer=self._event_sensor.bayer)

    def known(self) -> Known:
        """What a capture knows about its event camera."""
        return self._pixels.known()

    def notes(self) -> dict[str, Note]:
        """Remarks of a capture about its sensors."""
        return {**self._pixels.notes(), "row_delay_us": self._frame_sensor.row_delay_us}


P = TypeVar("P")

AHEAD = 32
"""Images rendered ahead by all cores; bounds memory."""
MARGIN_US = 10_000
"""The recording begins this long before the first exposure, and ends this long after the last."""
FOCAL_OF_WIDTH = 0.92
"""Focal length of the simulated camera over the image width: 57 degrees across."""


@dataclass(frozen=True)
class Timing:
    """Times of the exposures, and of the images from which light is integrated."""

    frames: int = 18
    exposure_us: int = 50_000
    """0 for sharp frames."""
    interval_us: int = 56_000
    """From one exposure's start to the next."""
    step_us: int = 1000
    """Between two images of the scene: 1000 for a camera of 1000 images per second."""
    most_change: float = 0.0
    """Largest change of log intensity between two images; where it is exceeded, images in between
    are rendered. 0 for even steps."""
    test_every: int = 8
    """One frame in so many is sharp and held out, the first included; 0 for none."""
    readout_us: int = 0
    """The recording is longer by this, while a rolling shutter reads the last frame."""

    def __post_init__(self) -> None:
        if self.frames < 1 or self.exposure_us < 0 or self.step_us < 1:
            raise OptionError(
                "frames and step must be positive, and exposure not negative",
                got=f"{self.frames}, {self.exposure_us} us, {self.step_us} us",
            )
        if self.interval_us < max(self.exposure_us, 1):
            raise OptionError(
                "exposures would overlap",
                got=f"one of {self.exposure_us} us every {self.interval_us} us",
                do="make the interval at least as long as the exposure",
            )

    @property
    def test(self) -> Int64[np.ndarray, "a"]:
        """Indices of the sharp frames that are held out."""
        if not self.test_every:
            return np.zeros(0, np.int64)
        return np.arange(0, self.frames, self.test_every)

    def exposure(self) -> Exposure:
        """All exposures; those of sharp frames have no length."""
        opens = MARGIN_US + np.arange(self.frames, dtype=np.int64) * self.interval_us
        closes = opens + self.exposure_us
        middle = opens + self.exposure_us // 2
        opens[self.test] = closes[self.test] = middle[self.test]
        return Exposure(opens, closes)

    def span_us(self) -> int:
        """Length of the recording."""
        return (
            (self.frames - 1) * self.interval_us
            + self.exposure_us
            + 2 * MARGIN_US
            + self.readout_us
        )


@dataclass(frozen=True)
class Rig:
    """The two sensors, which share a lens."""

    size: tuple[int, int] = (240, 160)
    """Width and height in px, of both."""
    frame_sensor: FrameSensor = field(default_factory=FrameSensor)
    event_sensor: EventSensor = field(default_factory=EventSensor)
    focal_of_width: float = FOCAL_OF_WIDTH
    """Focal length over the image width."""
    lens: str = "pinhole"
    distortion: tuple[float, ...] = ()
    """See `Camera`; the field of view must be below 180 degrees."""

    def camera(self) -> Camera:
        """A camera with square pixels."""
        width, height = self.size
        focal = self.focal_of_width * width
        return Camera(
            *(width, height, focal, focal, width / 2, height / 2), self.lens, self.distortion
        )


STANDARD_RIG, STANDARD_TIMING = Rig(), Timing()


def simulate(
    place: Scene | str = "garden",
    path: CameraPath | str = "glide",
    *,
    rig: Rig = STANDARD_RIG,
    timing: Timing = STANDARD_TIMING,
    seed: int = 0,
) -> Capture:
    """Record a scene with a moving camera.

    Args:
        place: A scene, or the name of one.
        path: A camera path, or the name of one, which then depends on the seed.
        rig: Sensors and their numbers.
        timing: Frames, exposures and sampling.
        seed: Of the path, the sensors' differences and their noise.

    Returns:
        A capture with everything known: the truth of blurry frames, poses every 5 ms, and in
        `notes` the thresholds of each pixel.
    """
    place = scene(place) if isinstance(place, str) else place
    path = motion(path, seed) if isinstance(path, str) else path
    readout = timing.readout_us or ceil(rig.frame_sensor.row_delay_us * (rig.size[1] - 1))
    timing = replace(timing, readout_us=readout)
    clock = Clock(0, timing.span_us())
    recorder = record(place, path, rig, timing, timing.exposure(), seed=seed)
    return Capture(
        camera=rig.camera(),
        trajectory=stamped(path, clock),
        clock=clock,
        near=place.near,
        far=place.far,
        frames=recorder.frames(),
        events=recorder.events(),
        split=Split(np.setdiff1d(np.arange(timing.frames), timing.test), timing.test),
        name=place.name,
        source="simulation",
        known=recorder.known(),
        notes=recorder.notes(),
    )


def record(
    place: Scene, path: CameraPath, rig: Rig, timing: Timing, exposure: Exposure, *, seed: int
) -> Recorder:
    """Record with both cameras of a rig; seed: of pixel differences and noise."""
    recorder = Recorder(
        rig.size, exposure, frame_sensor=rig.frame_sensor, event_sensor=rig.event_sensor, seed=seed
    )
    for t_us, rgb in images(place, path, rig.camera(), timing):
        recorder.see(rgb, t_us)
    return recorder


def view(
    place: Scene, camera: Camera, pose: Float64[np.ndarray, "3 4"], time_s: float = 0.0
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """Linear light and depth (along the camera's axis) of all pixels.

    Args:
        place: The scene.
        camera: The lens and sensor.
        pose: World-from-camera.
        time_s: Seconds, for scenes in which something moves.
    """
    across = _directions(camera) @ pose[:, :3].T
    rgb, depth = place.light(pose[None, :, 3], across, time_s, footprint_rad=1 / camera.fx_px)
    shape = camera.height, camera.width
    return rgb.reshape(*shape, 3), depth.reshape(shape)


def images(
    place: Scene, path: CameraPath, camera: Camera, timing: Timing
) -> Iterator[tuple[int, Float32[np.ndarray, "h w 3"]]]:
    """Times in us and linear images over a whole recording, in the order of time."""
    count = -(-timing.span_us() // timing.step_us)
    instants = np.minimum(np.arange(count + 1) * timing.step_us, timing.span_us())

    def draw(t_us: int) -> Float32[np.ndarray, "h w 3"]:
        return view(place, camera, path.poses(np.array([t_us]))[0], 1e-6 * t_us)[0]

    if timing.most_change:
        yield from watch(draw, instants, most_change=timing.most_change)
        return
    times = instants.tolist()
    yield from zip(times, drawn_ahead(draw, times), strict=True)


def drawn_ahead(draw: Callable[[int], P], times_us: Sequence[int]) -> Iterator[P]:
    """Images at some times, in their order, rendered by all cores."""
    with ThreadPoolExecutor(cpu_count()) as pool:
        for first in range(0, len(times_us), AHEAD):
            yield from pool.map(draw, times_us[first : first + AHEAD])


@lru_cache(maxsize=4)
def _directions(camera: Camera) -> Float64[np.ndarray, "n 3"]:
    """Directions of all pixels, with a z of 1, in camera axes."""
    unit = camera.direction(camera.grid().double()).reshape(-1, 3).numpy()
    return np.ascontiguousarray(unit / unit[:, 2:])
