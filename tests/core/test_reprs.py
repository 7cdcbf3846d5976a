"""What is printed fits on a line: counts and spans, never the numbers of an array."""

import numpy as np
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.events import EventStream
from sharpfield.core.frames import DepthMaps, Exposure, Frames
from sharpfield.core.rays import Radiance
from sharpfield.geometry.trajectory import Still
from sharpfield.storage.ply import SplatTable

CAMERA = Camera(6, 4, 5.0, 5.0, 3.0, 2.0)
NONE = np.zeros(0, np.int16)


def frames() -> Frames:
    opened = np.array([1000, 31_000])
    images = np.zeros((2, 4, 6, 3), np.uint8)
    exposure = Exposure(opened, opened + [20_000, 0])
    return Frames(images, exposure, np.zeros(2, np.int64), ("a", "b"), truth=images)


def stream() -> EventStream:
    t_us = np.arange(1000, 3000, 1)
    x, p = np.zeros(len(t_us), np.int16), np.ones(len(t_us), np.int8)
    return EventStream(x, x, t_us, p, 6, 4, bayer="RGGB", tracks=2)


def test_a_capture_and_its_parts_are_one_line_each() -> None:
    pose = np.eye(3, 4)[None]
    split = Split(np.array([0]), np.array([1]))
    capture = Capture(
        CAMERA, Still(pose), Clock(0, 60_000), 1.0, 2.0, frames(), stream(), split=split
    )
    assert repr(capture) == (
        "Capture('capture', 0.06 s: Frames(2 of 6x4, uint8, 3 channels, gamma2.2, 2 with sharp"
        " truth), EventStream(2,000 of 6x4, 1000 to 2999 us, 2 tracks, RGGB))"
    )
    assert repr(capture.split) == "Split(1 to learn from, 1 held out)"
    assert repr(frames().exposure) == "Exposure(2 frames, 1000 to 31000 us, each 0 to 20000 us)"
    assert repr(CAMERA) == "Camera(6x4, f 5 5 px, c 3 2 px)"


def test_what_is_empty_says_so() -> None:
    assert repr(EventStream(NONE, NONE, np.zeros(0, np.int64), NONE.astype(np.int8), 6, 4)) == (
        "EventStream(0 of 6x4)"
    )
    assert repr(Exposure(np.zeros(0, np.int64), np.zeros(0, np.int64))) == "Exposure(0 frames)"
    assert repr(DepthMaps(np.zeros((0, 4, 6), np.uint16), CAMERA)) == "DepthMaps(0 of 6x4)"


def test_structs_and_tables_show_shapes() -> None:
    plane = torch.zeros(2, 3)
    seen = Radiance(torch.zeros(2, 3, 1), plane, plane, plane)
    assert repr(seen) == "Radiance(rgb=[2, 3, 1], depth=[2, 3], opacity=[2, 3], weight=[2, 3])"
    rows = np.zeros((7, 3), np.float32)
    table = SplatTable(
        rows, np.zeros((7, 4), np.float32), rows, rows[:, 0], np.zeros((7, 4, 3), np.float32)
    )
    assert repr(table) == "SplatTable(7 Gaussians, 4 harmonics)"
