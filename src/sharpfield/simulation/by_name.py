"""Simulated captures of scenes by name: static scenes, moving scenes, or the room.

Each group of options has a default for every field, and ignores what a kind of scene does not have.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from sharpfield.core.errors import OptionError, expect_one_of

if TYPE_CHECKING:  # options are read without importing torch
    from sharpfield.core.capture import Capture
    from sharpfield.simulation.cameras.rigs import Views
    from sharpfield.simulation.room_capture import RoomSensors, RoomTiming
    from sharpfield.simulation.sensors.event_pixels import EventSensor
    from sharpfield.simulation.static_capture import Rig, Timing

ROOM = "room"
STILL_SIZE, MOVING_SIZE, ROOM_SIZE = (240, 160), (64, 64), (240, 180)
SIZES = "give width and height in px, at least (8, 8)"
SCANNET_EVERY = 5
"""Published work learns from one frame in so many of a ScanNet scene."""


@dataclass(frozen=True)
class RoomOptions:
    """A walk through the room, whose frames come with measured depth."""

    blurry: float = 0.75
    """Fraction of the room's training frames that is blurred."""
    blur: Literal["motion", "published"] = "motion"
    """By the motion of the camera, or each image by a random kernel, as published."""
    events: bool = False
    """Whether to simulate an event camera in the room; other scenes always have one."""
    depth_noise: float = 0.0
    """Standard deviation in metres of depth at one metre; it grows with the square of depth, and
    there are holes at edges, at grazing angles and beyond 5 m. A Kinect's is 0.0014."""
    drift: float = 0.0
    """Slow drift of the poses from the true ones, in metres."""

    @property
    def sensors(self) -> "RoomSensors":
        """Accuracy of depth and poses."""
        from sharpfield.simulation.room_capture import RoomSensors
        from sharpfield.simulation.sensors.frames import DepthSensor

        return RoomSensors(DepthSensor(self.depth_noise), self.drift)

    def timing(self, timed: "TimingOptions", layout: str) -> "RoomTiming":
        """When frames are taken; a layout that fixes what is held out has its own split."""
        from sharpfield.simulation.room_capture import RoomTiming

        given = {k: v for k, v in vars(timed).items() if v is not None}
        if "most_change" in given:
            raise OptionError("a walk has even steps", got="most_change", do="give step_us")
        return RoomTiming(
            blurry=self.blurry,
            blur=self.blur,
            events=self.events,
            train_every=SCANNET_EVERY if layout == "scannet" else 0,
            **given,
        )


ROOM_OPTIONS = RoomOptions()


@dataclass(frozen=True)
class RecordingOptions:
    """Motion and sensors of the simulated camera."""

    motion: str = "glide"
    """A camera path by name: glide, shaky."""
    sensor: str = "ideal"
    """An event camera by name: ideal, dvs346, gen3-vga, gen4-hd."""
    threshold: float | None = None
    """Contrast threshold of both signs, instead of the sensor's own."""
    colour: bool = False
    """Events behind a Bayer filter, and frames in linear light, as of a Color-DAVIS346."""
    rolling_shutter_ms: float = 0.0
    """Readout time of a frame, from the first row to the last; for static scenes."""
    lens: str = "pinhole"
    """Lens model: pinhole, brown, fisheye, or one of an installed package."""
    distortion: tuple[float, ...] = ()
    """Distortion coefficients in OpenCV's order: k1 k2 p1 p2 k3 (brown), k1 k2 k3 k4 (fisheye)."""
    walk: RoomOptions = ROOM_OPTIONS

    def sensors(self, base: "Rig", size: tuple[int, int]) -> "Rig":
        """The two sensors behind the lens of a rig."""
        from sharpfield.simulation.sensors.frames import FrameSensor

        events, frames = sensor_named(self.sensor), FrameSensor()
        if self.threshold is not None:
            events = replace(events, threshold_on=self.threshold, threshold_off=self.threshold)
        if self.colour:
            events, frames = replace(events, bayer="RGGB"), FrameSensor(encoding="linear")
        delay_us = 1000 * self.rolling_shutter_ms / max(size[1] - 1, 1)
        return replace(
            base,
            size=size,
            frame_sensor=replace(frames, row_delay_us=delay_us),
            event_sensor=events,
            lens=self.lens,
            distortion=self.distortion,
        )


@dataclass(frozen=True)
class RigOptions:
    """Cameras of a moving scene; static scenes have one, which moves."""

    rig: Literal["ring", "hand"] = "ring"
    """A ring of static cameras around the scene, or one hand-held camera."""
    views: int = 8
    """Cameras on the ring."""
    held_out: int = 4
    """Further cameras, whose frames and events are for testing."""

    def cameras(self, recording: RecordingOptions, seed: int) -> "Views":
        """Where they are."""
        from sharpfield.simulation.cameras.rigs import hand_held, ring

        if self.rig == "hand":
            return hand_held(recording.motion, seed=seed, held_out=self.held_out)
        return ring(self.views, held_out=min(self.held_out, self.views))


@dataclass(frozen=True)
class TimingOptions:
    """When the shutter opens, and how finely light is sampled; in brackets: moving scenes, room."""

    frames: int | None = None
    """Of each camera: 18 (33, 200)."""
    exposure_us: int | None = None
    """50000 (0: sharp frames, as long as the share of blurry frames needs)."""
    interval_us: int | None = None
    """From one exposure's start to the next: 56000 (31250, 100000)."""
    step_us: int | None = None
    """Between two images of the scene: 1000 (1250, 4000 for events only)."""
    most_change: float | None = None
    """Largest change of log intensity between two images, which are placed closer where it is
    exceeded; 0 for even steps."""
    test_every: int | None = None
    """Every how many frames one is held out: 8; of a moving scene, of the held-out cameras."""

    def over(self, base: "Timing") -> "Timing":
        """A timing with what was given in place of its own."""
        return replace(base, **{k: v for k, v in vars(self).items() if v is not None})


RECORDING, RIG, TIMING = RecordingOptions(), RigOptions(), TimingOptions()


def simulate_named(
    scene: str = "garden",
    *,
    size: tuple[int, int] | None = None,
    layout: str = "native",
    recording: RecordingOptions = RECORDING,
    rig: RigOptions = RIG,
    timing: TimingOptions = TIMING,
    seed: int = 0,
) -> "Capture":
    """Record a closed-form scene with simulated cameras: frames, events, poses, sharp truth.

    Args:
        scene: One of `SCENES`, which stand still; one of `MOVING_SCENES`; or "room".
        size: Width and height of the sensor in px; by default that of the kind of scene.
        layout: That it will be written in. ScanNet's fixes encoding and split.
        recording: Camera path and sensors.
        rig: Cameras of a moving scene.
        timing: Frames, exposures and sampling.
        seed: Random seed of the camera path and of all noise.

    Raises:
        OptionError: A name is unknown, or an option does not fit the scene.
    """
    from sharpfield.simulation.cameras.motions import MOTIONS
    from sharpfield.simulation.moving_capture import MOVING_RIG, MOVING_TIMING, simulate_moving
    from sharpfield.simulation.room_capture import ROOM_RIG, simulate_room
    from sharpfield.simulation.scenes.moving import MOVING_SCENES
    from sharpfield.simulation.scenes.static import SCENES
    from sharpfield.simulation.static_capture import Rig, Timing
    from sharpfield.simulation.static_capture import simulate as simulate_still

    expect_one_of("scene", scene, [*SCENES, *MOVING_SCENES, ROOM])
    expect_one_of("motion", recording.motion, MOTIONS)
    whole = isinstance(size, tuple | list) and all(isinstance(side, int) for side in size)
    if size is not None and not (whole and len(size) == 2 and min(size) >= 8):
        raise OptionError("this is not the size of a sensor", got=size, do=SIZES)
    if recording.rolling_shutter_ms and scene in (ROOM, *MOVING_SCENES):
        raise OptionError(
            "a rolling shutter is simulated only for scenes that stand still",
            got=f"the scene {scene}",
            do=f"use one of {', '.join(SCENES)}",
        )
    if scene == ROOM:
        sensors = recording.sensors(ROOM_RIG, size or ROOM_SIZE)
        if layout == "scannet":  # whose photos are sRGB
            sensors = replace(sensors, frame_sensor=replace(sensors.frame_sensor, encoding="srgb"))
        walk = recording.walk
        return simulate_room(
            rig=sensors, timing=walk.timing(timing, layout), sensors=walk.sensors, seed=seed
        )
    if scene in MOVING_SCENES:
        sensors = recording.sensors(MOVING_RIG, size or MOVING_SIZE)
        cameras, timed = rig.cameras(recording, seed), timing.over(MOVING_TIMING)
        return simulate_moving(scene, cameras, rig=sensors, timing=timed, seed=seed)
    sensors = recording.sensors(Rig(), size or STILL_SIZE)
    timed = timing.over(Timing())
    return simulate_still(scene, recording.motion, rig=sensors, timing=timed, seed=seed)


def sensor_named(name: str) -> "EventSensor":
    """An event sensor by its name.

    Raises:
        OptionError: There is none of this name.
    """
    from sharpfield.simulation.sensors.event_pixels import SENSORS

    expect_one_of("sensor", name, SENSORS)
    return SENSORS[name]
