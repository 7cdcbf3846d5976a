"""A capture from arrays of your own: what a driver, a rosbag or a converter gives you.

    python examples/04_your_capture.py

writes a folder that every command takes, reads it back, and shows what happens when a unit is
wrong. For a folder in a known layout `sharpfield inspect FOLDER` is enough.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro

import sharpfield as sf
from sharpfield import core


def main(size: tuple[int, int] = (64, 48), out: Path = Path("your_capture")) -> None:
    """Make up a recording; yours comes from files."""
    (width, height), random = size, np.random.default_rng(0)

    # A camera slides 0.2 m to the right within 300 ms; its pose is known every 10 ms:
    # world-from-camera, x right, y down, z forward. Times are whole microseconds everywhere.
    times_us = np.arange(0, 310_000, 10_000)
    poses = np.tile(np.eye(3, 4), (len(times_us), 1, 1))
    poses[:, 0, 3] = 0.2 * times_us / times_us[-1]
    clock = core.Clock(origin_us=0, span_us=300_000)
    opened = np.array([10_000, 80_000, 150_000, 220_000])
    frames = core.Frames(
        images=random.integers(0, 256, (4, height, width, 3), dtype=np.uint8),
        exposure=core.Exposure(opened, opened + 50_000),
        track=np.zeros(4, np.int64),  # all from the one moving camera
        names=("0000", "0001", "0002", "0003"),
        encoding="gamma2.2",  # how stored values relate to light
    )
    x, y = (random.integers(0, end, 5000, dtype=np.int16) for end in size)
    t_us = np.sort(random.integers(0, 300_000, 5000))
    p = random.choice(np.array([-1, 1], np.int8), 5000)  # -1 darker, +1 brighter
    capture = core.Capture(
        camera=core.Camera(width, height, 60.0, 60.0, width / 2, height / 2),  # f and centre, px
        trajectory=sf.geometry.Stamped(times_us, poses, clock),
        clock=clock,
        near=0.5,  # metres: the nearest thing before any camera
        far=5.0,
        frames=frames,
        events=core.EventStream(x, y, t_us, p, width, height),
        split=core.Split(train=np.array([0, 1, 2]), test=np.array([3])),
        known=core.Known(thresholds=core.Thresholds(negative=0.25, positive=0.25)),
    )
    sf.write(capture, out)
    print(sf.read(out))
    in_ns = replace(frames, exposure=core.Exposure(opened * 1000, opened * 1000))
    try:
        replace(capture, frames=in_ns)
    except core.CaptureError as error:
        print(error)


if __name__ == "__main__":
    tyro.cli(main)
