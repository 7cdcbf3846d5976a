"""Commands about captures: make one, look into one, deblur one."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_capture
from sharpfield.captures.summary import summary
from sharpfield.cli.arguments import Size, parse_size, screen
from sharpfield.core.capture import Capture
from sharpfield.preparation.deblurring import DeblurOptions, deblur_to
from sharpfield.runs.captures import LayoutName, write
from sharpfield.simulation.by_name import (
    RECORDING,
    RIG,
    TIMING,
    RecordingOptions,
    RigOptions,
    TimingOptions,
    sensor_named,
    simulate_named,
)
from sharpfield.simulation.footage import folder_footage, simulate_footage, video_footage

DEBLURRING = DeblurOptions()


def simulate(
    out: Path,
    scene: str = "garden",
    size: Size | None = None,
    layout: LayoutName = "native",
    seed: int = 0,
    recording: RecordingOptions = RECORDING,
    around: RigOptions = RIG,
    timing: TimingOptions = TIMING,
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
    made = simulate_named(
        scene,
        size=None if size is None else parse_size(size),
        layout=layout,
        recording=recording,
        rig=around,
        timing=timing,
        seed=seed,
    )
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
    opened = folder_footage if source.is_dir() else video_footage
    shown = opened(source, per_second=per_second)
    made = simulate_footage(shown, group=group, event_sensor=sensor_named(sensor), seed=seed)
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
    options = ReadOptions(layout=layout, event_unit=event_unit, trust_pickle=trust_pickle)
    found = summary(path, options)
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
    deblur_to(read_capture(capture, ReadOptions(layout=layout), poses=False), out, options)
    screen().print(f"Sharp frames are in {out}")


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


def _say_made(made: Capture, out: Path) -> None:
    frames = 0 if made.frames is None else len(made.frames)
    events = sum(len(one) for one in (made.events, made.test_events) if one is not None)
    screen().print(f"{frames} frames and {events:,} events are in {out}")
