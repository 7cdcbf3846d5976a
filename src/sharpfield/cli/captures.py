"""Commands about captures: make one, look into one, deblur one."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_unposed
from sharpfield.captures.summary import summary
from sharpfield.captures.writers import evdnerf as write_evdnerf
from sharpfield.captures.writers import llff_events as write_llff_events
from sharpfield.captures.writers import scannet as write_scannet
from sharpfield.cli.arguments import Size, parse_size, screen
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.preparation.deblur import DeblurOptions, deblur_to
from sharpfield.simulation.cameras.motion import MOTIONS
from sharpfield.simulation.cameras.rigs import Views, hand_held, ring
from sharpfield.simulation.footage import folder_footage, simulate_footage, video_footage
from sharpfield.simulation.scenes.moving import MOVING_SCENES
from sharpfield.simulation.scenes.static import SCENES
from sharpfield.simulation.sensors.depth import DepthSensor
from sharpfield.simulation.sensors.event_pixels import SENSORS
from sharpfield.simulation.sensors.frames import FrameSensor
from sharpfield.simulation.simulate import Rig, Timing
from sharpfield.simulation.simulate import simulate as simulate_scene
from sharpfield.simulation.simulate_moving import MOVING_RIG, MOVING_TIMING, simulate_moving
from sharpfield.simulation.simulate_room import ROOM_RIG, RoomSensors, RoomTiming, simulate_room


@dataclass(frozen=True)
class RoomOptions:
    """A walk through the room, whose frames come with measured depth."""

    blurry: float = 0.75
    """Share of the room's training frames that is blurred."""
    blur: Literal["motion", "published"] = "motion"
    """By the walk, or each image by a random kernel, as published."""
    events: bool = False
    """Whether an event camera walks along; other scenes always have one."""
    depth_noise: float = 0.0
    """Standard deviation in metres of depth at one metre; it grows with the square of depth, and
    there are holes at edges, at grazing angles and beyond 5 m. A Kinect's is 0.0014."""
    drift: float = 0.0
    """Metres by which poses stray slowly from the true ones."""

    @property
    def sensors(self) -> RoomSensors:
        """How well depth and poses are known."""
        return RoomSensors(DepthSensor(self.depth_noise), self.drift)

    def timing(self, timed: "Timed", layout: str) -> RoomTiming:
        """When frames are taken; a layout that fixes what is held out has its own split."""
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
class Recording:
    """How the simulated camera moves and what its sensors are like."""

    motion: str = "glide"
    """A camera path by name: glide, shaky."""
    sensor: str = "ideal"
    """An event camera by name: ideal, dvs346, gen3-vga, gen4-hd."""
    threshold: float | None = None
    """Contrast threshold of both signs, instead of the sensor's own."""
    colour: bool = False
    """Events behind a Bayer filter, and frames in linear light, as a Color-DAVIS346 gives them."""
    rolling_shutter_ms: float = 0.0
    """How much later the last row of a frame is exposed than the first; scenes that stand still."""
    lens: Literal["pinhole", "brown", "fisheye"] = "pinhole"
    """A lens model; see `distortion`."""
    distortion: tuple[float, ...] = ()
    """Its coefficients, as OpenCV's: k1 k2 p1 p2 k3 of brown, k1 k2 k3 k4 of fisheye."""
    walk: RoomOptions = ROOM_OPTIONS

    def sensors(self, base: Rig, size: tuple[int, int]) -> Rig:
        """The two sensors behind the lens of a rig."""
        _known("sensor", self.sensor, SENSORS)
        events, frames = SENSORS[self.sensor], FrameSensor()
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
    """Cameras before a moving scene; scenes that stand still have one, which moves."""

    rig: Literal["ring", "hand"] = "ring"
    """Cameras that stand around it, or one that is carried."""
    views: int = 8
    """Cameras on the ring."""
    held_out: int = 4
    """Further cameras, whose frames and events are for testing."""

    def cameras(self, recording: Recording, seed: int) -> Views:
        """Where they are."""
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

    def over(self, base: Timing) -> Timing:
        """A timing with what was given in place of its own."""
        return replace(base, **{k: v for k, v in vars(self).items() if v is not None})


RECORDING, AROUND, TIMED, DEBLURRING = Recording(), RigOptions(), TimingOptions(), DeblurOptions()
STILL_SIZE, MOVING_SIZE, ROOM_SIZE = "240x160", "64x64", "240x180"
ROOM = "room"
SCANNET_EVERY = 5
"""Published work learns from one frame in so many of a ScanNet scene."""


def simulate(
    out: Path,
    scene: str = "garden",
    size: Size | None = None,
    layout: Literal["native", "ev-deblur-nerf", "evdnerf", "scannet"] = "native",
    seed: int = 0,
    recording: Recording = RECORDING,
    around: RigOptions = AROUND,
    timing: TimingOptions = TIMED,
) -> None:
    """Record a closed-form scene with simulated cameras: frames, events, poses, sharp truth.

    Args:
        out: Folder of the capture.
        scene: A scene by name: garden, shelf, tiles, mobile; spinner, arm, jelly, glider, puppet,
            which move and are seen from all around; or room, walked through with a depth camera.
        size: Of the sensor, in pixels; by default 240x160, 64x64 for a moving scene, or 240x180
            for the room.
        layout: Files to write.
        seed: Of the camera path and of all noise.
        recording: Path and sensors.
        around: Cameras of a moving scene.
        timing: Frames, exposures and sampling.
    """
    _known("scene", scene, [*SCENES, *MOVING_SCENES, ROOM])
    _known("motion", recording.motion, MOTIONS)
    if recording.rolling_shutter_ms and scene in (ROOM, *MOVING_SCENES):
        raise OptionError(
            "a rolling shutter is simulated for scenes that stand still, before a camera",
            got=f"--scene {scene}",
            do=f"use one of {', '.join(SCENES)}",
        )
    if scene == ROOM:
        rig = recording.sensors(ROOM_RIG, parse_size(size or ROOM_SIZE))
        if layout == "scannet":  # whose photos are sRGB
            rig = replace(rig, frame_sensor=replace(rig.frame_sensor, encoding="srgb"))
        walk = recording.walk
        made = simulate_room(
            rig=rig, timing=walk.timing(timing, layout), sensors=walk.sensors, seed=seed
        )
    elif scene in MOVING_SCENES:
        rig = recording.sensors(MOVING_RIG, parse_size(size or MOVING_SIZE))
        views, timed = around.cameras(recording, seed), timing.over(MOVING_TIMING)
        made = simulate_moving(scene, views, rig=rig, timing=timed, seed=seed)
    else:
        rig = recording.sensors(Rig(), parse_size(size or STILL_SIZE))
        timed = timing.over(Timing())
        made = simulate_scene(scene, recording.motion, rig=rig, timing=timed, seed=seed)
    write(replace(made, name=out.name), out, layout)
    _say_made(made, out)


def footage(
    source: Positional[Path],
    out: Path,
    group: int = 40,
    per_second: float | None = None,
    sensor: str = "ideal",
    seed: int = 0,
) -> None:
    """Turn sharp high-rate images into blurry frames and events (poses stay unknown).

    Args:
        source: A video, or a folder of images.
        out: Folder of the capture.
        group: Consecutive images in one exposure.
        per_second: Images taken per second; a folder needs it, a video may say it itself.
        sensor: An event camera by name.
        seed: Of all noise.
    """
    _known("sensor", sensor, SENSORS)
    opened = folder_footage if source.is_dir() else video_footage
    shown = opened(source, per_second=per_second)
    made = simulate_footage(shown, group=group, event_sensor=SENSORS[sensor], seed=seed)
    native.write(replace(made, name=out.name), out)
    _say_made(made, out)


def inspect(
    path: Positional[Path],
    json: bool = False,
    layout: str | None = None,
    event_unit: str | None = None,
    trust_pickle: bool = False,
) -> None:
    """Say what a capture, or a file of events, holds.

    Args:
        path: A capture's folder, or a file of events.
        json: Print JSON instead of text.
        layout: Of the capture, if it is not recognised.
        event_unit: Unit of event times (ns, us, ms, s), where the file does not say.
        trust_pickle: Open pickled files, which may name programs to run; only arrays of numbers
            are built from them, and anything else is refused.
    """
    found = summary(path, layout=layout, event_unit=event_unit, trust_pickle=trust_pickle)
    print(_as_json(found) if json else as_text(found))


def deblur(
    capture: Positional[Path],
    out: Path,
    layout: str | None = None,
    options: DeblurOptions = DEBLURRING,
) -> None:
    """Sharpen blurry frames with the event double integral; nothing is trained.

    Args:
        capture: Folder of the capture.
        out: Folder for the images, a contact sheet and `deblur.json`.
        layout: Of the capture, if it is not recognised.
        options: Method, instants.
    """
    deblur_to(read_unposed(capture, layout=layout), out, options)
    screen().print(f"Sharp frames are in {out}")


def write(capture: Capture, out: Path, layout: str) -> None:
    """Write a capture in a layout."""
    writers = {
        "native": native,
        "ev-deblur-nerf": write_llff_events,
        "evdnerf": write_evdnerf,
        "scannet": write_scannet,
    }
    writers[layout].write(capture, out)


def as_text(found: dict[str, Any], indent: int = 0) -> str:
    """Nested values, a line each."""
    lines = []
    for key, value in found.items():
        if isinstance(value, dict):
            lines += [" " * indent + key, as_text(value, indent + 2)]
        else:
            shown = f"{value:,}" if isinstance(value, int) and value > 9999 else value
            lines.append(f"{' ' * indent}{key:<{22 - indent}} {shown}")
    return "\n".join(lines)


def _as_json(found: dict[str, Any]) -> str:
    return json.dumps(found, indent=2)


def _known(name: str, value: str, names: Any) -> None:
    if value not in names:
        raise OptionError(f"unknown {name}", got=value, do=f"use one of {', '.join(names)}")


def _say_made(made: Capture, out: Path) -> None:
    frames = 0 if made.frames is None else len(made.frames)
    events = sum(len(one) for one in (made.events, made.test_events) if one is not None)
    screen().print(f"{frames} frames and {events:,} events are in {out}")
