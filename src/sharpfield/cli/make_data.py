"""`sharpfield simulate` and `sharpfield footage`: captures made by simulated sensors.

`sharpfield demo`: record a scene, rebuild it by three methods, and compare them.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from sharpfield.captures.layout import LayoutName
from sharpfield.cli.arguments import Device, Size, parse_size, screen
from sharpfield.simulation.by_name import (
    RECORDING,
    RIG,
    TIMING,
    RecordingOptions,
    RigOptions,
    TimingOptions,
)


def simulate_command(
    out: Path,
    scene: str = "garden",
    size: Size | None = None,
    layout: LayoutName = "native",
    seed: int = 0,
    recording: RecordingOptions = RECORDING,
    rig: RigOptions = RIG,
    timing: TimingOptions = TIMING,
) -> None:
    """Record a closed-form scene with simulated cameras: frames, events, poses, ground truth.

    Args:
        out: Folder of the capture.
        scene: A scene by name: garden, shelf, tiles, mobile; spinner, arm, jelly, glider, puppet,
            which move and are seen from all around; or room, walked through with a depth camera.
        size: Sensor resolution, WIDTHxHEIGHT; by default 240x160, 64x64 for a moving scene, or
            240x180 for the room.
        layout: Layout of the files to write.
        seed: Random seed of the camera path and of the noise.
        recording: Camera path and sensors.
        rig: Cameras around a moving scene.
        timing: Frames, exposures and sampling.
    """
    from sharpfield.runs.start import write
    from sharpfield.simulation.by_name import simulate_named

    made = simulate_named(
        scene,
        size=None if size is None else parse_size(size),
        layout=layout,
        recording=recording,
        rig=rig,
        timing=timing,
        seed=seed,
    )
    write(replace(made, name=out.name), out, layout)
    _say_made(made, out)


def footage_command(
    source: Positional[Path],
    out: Path,
    group: int = 40,
    fps: float | None = None,
    sensor: str = "ideal",
    seed: int = 0,
) -> None:
    """Turn sharp high-rate images into blurry frames and events (poses stay unknown).

    Args:
        source: A video file, or a folder of images.
        out: Folder of the capture.
        group: Number of consecutive images in one exposure.
        fps: Frames per second of the footage; a folder needs it, a video file may state it.
        sensor: Name of the event camera: ideal, dvs346, gen3-vga, gen4-hd.
        seed: Random seed of the noise.
    """
    from sharpfield.captures.native.layout import write
    from sharpfield.simulation.by_name import sensor_named
    from sharpfield.simulation.footage import folder_footage, simulate_footage, video_footage

    opened = folder_footage if source.is_dir() else video_footage
    images = opened(source, per_second=fps)
    made = simulate_footage(images, group=group, event_sensor=sensor_named(sensor), seed=seed)
    write(replace(made, name=out.name), out)
    _say_made(made, out)


def _say_made(made: Any, out: Path) -> None:
    frames = 0 if made.frames is None else len(made.frames)
    events = sum(len(one) for one in (made.events, made.test_events) if one is not None)
    screen().print(f"{frames} frames and {events:,} events are in {out}")


def demo_command(
    out: Path = Path("runs/demo"),
    size: Size = "240x160",
    scene: str = "garden",
    minutes: float = 1.0,
    seed: int = 0,
    device: Device = "auto",
) -> None:
    """Record a scene with a shaky camera, rebuild it sharply, and compare with two baselines.

    Args:
        out: Folder of the run; its report.html shows everything.
        size: Sensor resolution of the simulated camera, WIDTHxHEIGHT.
        scene: Name of a closed-form scene: garden, shelf, tiles or mobile.
        minutes: Training time of each of the three methods.
        seed: Random seed of the recording and of training.
        device: Device to train on.
    """
    from sharpfield.runs.demo import run_demo

    run_demo(out, parse_size(size), scene, minutes, seed, device=device)
