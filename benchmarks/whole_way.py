"""One recording in five containers, from the camera's file to a report, by a user's commands.

    python -m benchmarks.whole_way [--sfm] [--steps N]

A scene is simulated with a noisy sensor and written as AEDAT4, as EVT3 RAW with a (lossless) video,
as a ROS bag, as DSEC's HDF5 with images, and as a text with images. Each goes through `ingest`,
`doctor`, `poses`, `train` and `evaluate`. Poses are attached from a file, or found with `--sfm`.
"""

import argparse
import hashlib
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.table import Row, save, show
from sharpfield.captures.native import layout as native
from sharpfield.cli.commands import main as sharpfield
from sharpfield.core.capture import Capture
from sharpfield.geometry.se3 import quaternion_from_rotation
from sharpfield.geometry.trajectory import Stamped
from sharpfield.recordings.recording import Frame, Recording
from sharpfield.simulation.sensors.event_pixels import SENSORS
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.storage.event_writer import write_events
from sharpfield.storage.evt_writer import writing_evt
from sharpfield.storage.images import write_image
from tests.recordings.aedat.aedat4_writer import write_aedat4
from tests.recordings.ros.ros1_writer import write_ros1_bag

EXPOSURE_US, INTERVAL_US = 30_000, 40_000
Words = tuple[object, ...]


def recorded(size: tuple[int, int], frames: int) -> Capture:
    """What the camera sees."""
    return simulate(
        "garden",
        "shaky",
        rig=Rig(size, event_sensor=SENSORS["dvs346"]),
        timing=Timing(frames, EXPOSURE_US, INTERVAL_US, test_every=0),
        seed=7,
    )


def written(capture: Capture, folder: Path) -> dict[str, Words]:
    """The containers by name, each as what `ingest` is told: files, and what they do not say."""
    frames, events = capture.needed_frames, capture.needed_events
    open_us, close_us = frames.exposure.open_us, frames.exposure.close_us
    shots = [
        Frame(image, int(begin), int(end))
        for image, begin, end in zip(frames.images, open_us, close_us, strict=True)
    ]
    one = Recording(
        folder,
        "simulated",
        (events.width, events.height),
        events=lambda: iter([events]),
        frames=lambda: iter(shots),
    )
    write_aedat4(folder / "one.aedat4", one)
    write_ros1_bag(folder / "one.bag", one)
    with writing_evt(folder / "one.raw", events[:0]) as raw:
        raw.append(events)
    write_events(folder / "one.h5", events)
    columns = np.column_stack([events.t_us, events.x, events.y, events.p > 0])
    np.savetxt(folder / "events.txt", columns, "%d")
    for image, name in zip(frames.images, frames.names, strict=True):
        write_image(folder / "images" / f"{name}.png", image)
    exposures = np.column_stack([open_us, close_us])
    np.savetxt(folder / "images" / "exposures.txt", exposures, "%d", delimiter=", ")
    video = cv2.VideoWriter(
        str(folder / "one.avi"),
        cv2.VideoWriter_fourcc(*"FFV1"),  # pyright: ignore
        1e6 / INTERVAL_US,
        (events.width, events.height),
    )
    for image in frames.images:
        video.write(np.ascontiguousarray(image[..., ::-1]))
    video.release()
    size = ("--size", f"{events.width}x{events.height}")
    images = ("--clock", "same", "--frame-unit", "us")
    shutter = ("--exposure", f"{EXPOSURE_US}us", "--offset-ms", open_us[0] / 1000)
    return {
        "AEDAT4": (folder / "one.aedat4",),
        "EVT3 and video": (folder / "one.raw", folder / "one.avi", *shutter),
        "ROS bag": (folder / "one.bag",),
        "DSEC HDF5": (folder / "one.h5", folder / "images", *images),
        "text": (folder / "events.txt", folder / "images", *images, *size, "--unit", "us"),
    }


def path_file(capture: Capture, file: Path) -> Path:
    """The true poses as TUM has them."""
    path = capture.trajectory
    assert isinstance(path, Stamped)
    turn = quaternion_from_rotation(torch.from_numpy(path.poses[:, :, :3].copy())).numpy()
    turn = np.roll(turn, -1, -1)
    np.savetxt(file, np.column_stack([path.times_us / 1e6, path.poses[:, :, 3], turn]), "%.9f")
    return file


def command(*words: object) -> None:
    """Run a command as a user would."""
    try:
        sharpfield([str(word) for word in words])
    except SystemExit as end:
        if end.code:
            raise


def gone(name: str, told: Words, folder: Path, *, poses: Words, steps: Words) -> Row:
    """All the way of one container."""
    began, place = time.perf_counter(), folder / name.replace(" ", "-")
    row = {"container": name, **taken_in(told, place, poses=poses), "errors": errors(place)}
    row["psnr"] = learned(place, steps=steps)
    return row | {"s": round(time.perf_counter() - began, 1)}


def taken_in(told: Words, place: Path, *, poses: Words) -> Row:
    """From a container to a capture with poses."""
    command("ingest", *told, "--out", place / "cap", "--encoding", "gamma2.2")
    command("poses", place / "cap", "--out", place / "posed", *poses)
    capture = native.read(place / "posed")
    return {
        "events": len(capture.needed_events),
        "frames": len(capture.needed_frames),
        "digest": digest(capture),
    }


def errors(place: Path) -> int:
    """How many the doctor finds in a capture before it has poses."""
    command("doctor", place / "cap", "--out", place / "doctor")
    checkup: dict[str, Any] = json.loads((place / "doctor" / "doctor.json").read_text())
    return checkup["counts"]["error"]


def learned(place: Path, *, steps: Words) -> float:
    """From a capture with poses to a score, the mean PSNR of held-out views."""
    run = ("--out", place / "run", "--hold-out", "every:4", *steps)
    command("train", "ev-splat", place / "posed", *run)
    command("evaluate", place / "run")
    metrics = json.loads((place / "run" / "metrics.json").read_text())
    return round(metrics["mean"]["psnr"], 6)


def digest(capture: Capture) -> str:
    """Of all events, pixels, exposures and poses."""
    events, frames, path = capture.needed_events, capture.needed_frames, capture.trajectory
    assert isinstance(path, Stamped)
    whole = hashlib.sha256()
    for kind, column in (
        ("<i4", events.x), ("<i4", events.y), ("<i8", events.t_us), ("i1", events.p),
        ("u1", frames.images), ("<i8", frames.exposure.open_us), ("<i8", frames.exposure.close_us),
        ("<f8", path.poses),
    ):  # fmt: skip
        whole.update(np.ascontiguousarray(column, kind).tobytes())
    return whole.hexdigest()[:12]


def whole_way(
    folder: Path, size: tuple[int, int], frames: int, *, steps: Words, sfm: bool
) -> list[Row]:
    """A row for each container."""
    capture = recorded(size, frames)
    containers = written(capture, folder)
    poses: Words = ()
    if not sfm:
        bounds = ("--bounds", capture.near, capture.far)
        poses = ("--trajectory", path_file(capture, folder / "path.txt"), *bounds)
    return [gone(name, told, folder, poses=poses, steps=steps) for name, told in containers.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description="One recording in five containers.")
    parser.add_argument("--sfm", action="store_true", help="find the poses")
    parser.add_argument("--steps", type=int, default=30)
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = whole_way(Path(folder), (192, 128), 12, steps=("--steps", told.steps), sfm=told.sfm)
    show(rows)
    print(save("whole_way" + "_sfm" * told.sfm, rows, {"steps": told.steps}))


if __name__ == "__main__":
    main()
