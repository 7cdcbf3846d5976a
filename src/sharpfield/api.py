"""The Python interface: what `import sharpfield as sf` offers as functions.

Thin: each function says its options by name and calls what the command line calls, too. Their
lists of options are longer than elsewhere, so that `help(sf.train)` shows all there is.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from sharpfield.captures.layout import LayoutName, ReadOptions
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.preparation.deblurring import Deblurred, deblur_frames, deblur_to
from sharpfield.preparation.options import DeblurOptions
from sharpfield.recipes import recipe_named
from sharpfield.recipes.settings.options import with_options
from sharpfield.recipes.settings.presets import prepared
from sharpfield.recordings.open import open_recording as open_any
from sharpfield.recordings.recording import ReaderOptions, Recording
from sharpfield.runs.config import OWN_CAPTURE, STREAMS, RunConfig, device_named
from sharpfield.runs.run import Run, open_run
from sharpfield.runs.start import expect_capture, train_run, write
from sharpfield.simulation.by_name import (
    RecordingOptions,
    RigOptions,
    RoomOptions,
    TimingOptions,
    simulate_named,
)
from sharpfield.training.options import TrainingOptions

__all__ = ["deblur", "open_recording", "open_run", "read", "simulate", "train", "write"]


def read(
    path: Path | str,
    *,
    layout: str | None = None,
    event_unit: str | None = None,
    missing: Literal["error", "skip"] | None = None,
    encoding: str | None = None,
    hold_out: str | None = None,
    threshold: float | None = None,
    factor: int | None = None,
    bounds: tuple[float, float] | None = None,
    trust_pickle: bool = False,
    poses: bool = True,
) -> Capture:
    """Read a capture from a folder.

    Args:
        path: The folder.
        layout: Of its files, such as "native", "ev-deblur-nerf", "nerfstudio" or "colmap"; by
            default it is recognised.
        event_unit: Unit of the event times (ns, us, ms, s), where it is not what the layout has.
        missing: Whether images that are named but not there are an "error" or to "skip".
        encoding: How stored values relate to light (linear, gamma2.2, srgb), where the layout is
            wrong.
        hold_out: Frames to hold out: every:8, train:5, last:5 or none; by default as the layout
            says.
        threshold: Contrast threshold of the events for both signs, natural log, where it is known
            better.
        factor: Read the images in `images_<factor>`; by default the smallest images there are.
        bounds: Nearest and farthest depth of the scene, in world units.
        trust_pickle: Open pickled files, which may name programs to run; only arrays of numbers
            are built from them, and anything else is refused.
        poses: Whether its poses must be known; `deblur` needs none.

    Raises:
        CaptureError: The capture cannot be read, or its poses are not known yet.
        OptionError: An option does not fit the layout.
    """
    _expect_path(path)
    options = ReadOptions(
        layout=layout,
        event_unit=event_unit,
        missing=missing,
        encoding=encoding,
        hold_out=hold_out,
        threshold=threshold,
        factor=factor,
        bounds=bounds,
        trust_pickle=trust_pickle,
    )
    return read_capture(path, options, poses=poses)


def open_recording(
    path: Path | str,
    *,
    layout: str | None = None,
    unit: str | None = None,
    size: tuple[int, int] | None = None,
    topic: str | None = None,
    image_topic: str | None = None,
    columns: str | None = None,
    event_encoding: str | None = None,
    frame_unit: str | None = None,
    fps: float | int | None = None,
    times: Path | str | None = None,
) -> Recording:
    """Open what a camera or a program has written; events and frames are read when asked for.

    Options say what the file does not, or where it is wrong.

    Args:
        path: A file or a folder.
        layout: Name of the format, such as evt, aedat4, rosbag or hdf5; by default it is
            recognised.
        unit: Of the event times: ns, us, ms or s.
        size: Resolution of the event sensor in px, width and height.
        topic: Which of several cameras, streams or topics to take the events from.
        image_topic: Which of several to take the images from; an empty text for none.
        columns: Order of the columns in a table of events: xytp or txyp.
        event_encoding: Of a Prophesee RAW file: evt2, evt2.1, evt2.1-legacy or evt3.
        frame_unit: Unit of the image times: ns, us, ms or s.
        fps: Frames recorded per second, where no file gives their times, or a video is slow motion.
        times: The file with the image times, where there are several candidates.

    Returns:
        What is known of the sensor; `load()` or `chunks()` for its events, `frames()` for images.

    Raises:
        CaptureError: The file is missing, of no known format, damaged, or leaves something open.
        OptionError: An option does not belong to the format.
    """
    _expect_path(path)
    options = ReaderOptions(
        unit,
        size,
        topic,
        image_topic,
        columns,
        event_encoding,
        frame_unit,
        None if fps is None else float(fps),
        None if times is None else Path(times),
    )
    return open_any(path, options, layout=layout)


def simulate(
    scene: str = "garden",
    *,
    size: tuple[int, int] | None = None,
    frames: int | None = None,
    seed: int = 0,
    out: Path | str | None = None,
    layout: LayoutName = "native",
    motion: str = "glide",
    sensor: str = "ideal",
    threshold: float | None = None,
    colour: bool = False,
    rolling_shutter_ms: float = 0.0,
    lens: Literal["pinhole", "brown", "fisheye"] = "pinhole",
    distortion: tuple[float, ...] = (),
    exposure_us: int | None = None,
    interval_us: int | None = None,
    step_us: int | None = None,
    most_change: float | None = None,
    test_every: int | None = None,
    rig: Literal["ring", "hand"] = "ring",
    views: int = 8,
    held_out: int = 4,
    blurry: float = 0.75,
    blur: Literal["motion", "published"] = "motion",
    events: bool = False,
    depth_noise: float = 0.0,
    drift: float = 0.0,
) -> Capture:
    """Record a closed-form scene with simulated cameras: frames, events, poses, sharp truth.

    Args:
        scene: One that stands still (garden, shelf, tiles, mobile), one that moves before a rig of
            cameras (spinner, arm, jelly, glider, puppet), or room, which is walked through with a
            depth camera.
        size: Width and height of the sensor in px; by default (240, 160), (64, 64) for a scene
            that moves, (240, 180) for the room.
        frames: Of each camera; by default 18 (33 where the scene moves, 200 in the room).
        seed: Random seed of the camera path and of all noise.
        out: Folder to write the capture to; by default it exists only in memory.
        layout: Files to write: native, ev-deblur-nerf, evdnerf, scannet.
        motion: Of the camera: glide, shaky.
        sensor: Of the events: ideal, dvs346, gen3-vga, gen4-hd.
        threshold: Contrast threshold of both signs, natural log, instead of the sensor's own.
        colour: Whether events come from behind a Bayer filter, and frames are linear.
        rolling_shutter_ms: From the exposure of the first row to that of the last.
        lens: Model of the lens.
        distortion: Its coefficients, as OpenCV's: k1 k2 p1 p2 k3, or k1 k2 k3 k4 of a fisheye.
        exposure_us: Length of an exposure; 0 for sharp frames.
        interval_us: From the start of one exposure to that of the next.
        step_us: Between two images of the scene, whose mean is a blurred frame.
        most_change: Largest change of log intensity between two such images, which are placed
            closer where it is exceeded; 0 for even steps.
        test_every: Every how many frames one is sharp and held out; 0 for none.
        rig: Cameras before a moving scene: a ring of still ones, or one in a hand.
        views: Cameras on the ring.
        held_out: Further cameras, for testing.
        blurry: Share of the room's training frames that is blurred.
        blur: In the room: by the walk's motion, or each image by a random kernel, as published.
        events: Whether an event camera walks along through the room; other scenes have one.
        depth_noise: Standard deviation in metres of the room's depth at one metre.
        drift: Metres by which the room's poses stray from the true ones.

    Raises:
        OptionError: A name is unknown, or an option does not fit the scene.
    """
    room = RoomOptions(blurry, blur, events, depth_noise, drift)
    made = simulate_named(
        scene,
        size=size,
        layout=layout,
        recording=RecordingOptions(
            motion, sensor, threshold, colour, rolling_shutter_ms, lens, distortion, room
        ),
        rig=RigOptions(rig, views, held_out),
        timing=TimingOptions(frames, exposure_us, interval_us, step_us, most_change, test_every),
        seed=seed,
    )
    if out is not None:
        made = replace(made, name=Path(out).name)
        write(made, out, layout)
    return made


def deblur(
    capture: Capture,
    *,
    threshold: float | Literal["known", "find"] = "known",
    method: Literal["exact", "joint", "published"] = "exact",
    instants: int = 1,
    out: Path | str | None = None,
) -> Deblurred:
    """Sharp images of the blurred frames by the event double integral; nothing is trained.

    Args:
        capture: With frames and events; its poses are not used.
        threshold: Contrast threshold of both signs, natural log; or "known" for what the capture
            says, "find" to estimate it.
        method: "exact" integrates in linear light, from event to event; "joint" makes all frames
            agree with the events between them, too; "published" is Ev-DeblurNeRF's.
        instants: Images of each exposure, evenly spread; more than one only for "exact".
        out: Folder for the images, a contact sheet and `deblur.json`.

    Returns:
        The images as the frames are stored, [n, instants, h, w, c], with their frames and times.

    Raises:
        CaptureError: Frames or events are missing, or no frame is blurred.
        OptionError: The method does not give several images.
    """
    expect_capture(capture)
    options = DeblurOptions(threshold, method, instants)
    return (
        deblur_frames(capture, options) if out is None else deblur_to(capture, Path(out), options)
    )


def train(
    recipe: str,
    capture: Capture | Path | str,
    *,
    out: Path | str,
    minutes: float | int | None = None,
    steps: int | None = None,
    preset: str = "",
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    use: tuple[str, ...] = STREAMS,
    block: str = "",
    resume: bool = False,
    memory_gb: float | None = None,
) -> Run:
    """Train a recipe on a capture.

    A capture that is given by its folder is only referred to. One that is given as an object is
    written to `OUT/capture`, so that the run can be opened later; name the folder of a long one.

    Args:
        recipe: Its name; `list(sf.recipes.RECIPES)` has them.
        capture: A capture, or the folder of one.
        out: Folder of the run.
        minutes: Time for training; the schedule is made to fit into it.
        steps: Length of the schedule, instead of `minutes`; by default what the preset says.
        preset: Named settings, several with commas between them; by default they follow the
            capture and the device.
        options: Single options of the recipe by dotted name, such as `{"sampling.views": 5}`;
            `sharpfield recipes describe RECIPE` lists them.
        seed: Random seed.
        device: Where to train.
        use: Streams of the capture to learn from: frames, events.
        block: Part of a long capture, "2/4" for the second of four.
        resume: Go on with the run in `out`, started with the same options.
        memory_gb: Memory for training, in GiB; None for most of what is free.

    Returns:
        The run, with its trained model.

    Raises:
        OptionError: There is no such recipe, preset or option.
        CaptureError: The capture cannot be read, or lacks what the recipe needs.
        RunError: `out` already holds a run, or a loss is not finite.
    """
    if not isinstance(capture, Path | str):
        expect_capture(capture)
    recipe_named(recipe)  # before anything is read
    where = device_named(device)
    length = TrainingOptions(steps=steps, minutes=minutes, resume=resume, memory_gb=memory_gb)
    in_memory = isinstance(capture, Capture)
    source = capture if in_memory else read_capture(capture)
    made = prepared(recipe, preset, capture=source, device=where)
    config = RunConfig(
        recipe,
        with_options(made, options or {}),
        OWN_CAPTURE if in_memory else str(Path(capture).resolve()),
        seed,
        use,
        block=block,
    )
    return train_run(config, source, Path(out), length, device=where)


def _expect_path(path: object) -> None:
    if not isinstance(path, Path | str):
        raise OptionError("this is not a path", got=type(path).__name__, do="give a Path or a text")
