"""Weights of frames: blurred copies of one picture are worth less than the picture."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sharpfield.core import Camera, Capture, Clock, EventStream, Exposure, Frames, Split
from sharpfield.geometry import Still
from sharpfield.recipes.frame_weights import LEAST, frame_weights

BLUR = (0.0, 2.0, 0.0, 1.0, 3.0, 0.0)


def walk() -> Capture:
    """Six pictures of one thing, blurred more or less, with events where they are blurred."""
    draw = np.random.default_rng(0)
    sharp = draw.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    images = np.stack([cv2.GaussianBlur(sharp, (0, 0), s) if s else sharp for s in BLUR])
    opens = np.arange(6) * 10_000
    t_us = np.concatenate(
        [
            o + np.linspace(0, 4_000, int(50 * s), dtype=np.int64)
            for o, s in zip(opens, BLUR, strict=True)
        ]
    )
    none = np.zeros(len(t_us), np.uint16)
    return Capture(
        camera=Camera(40, 30, 30.0, 30.0, 20.0, 15.0),
        trajectory=Still(np.eye(3, 4)[None]),
        clock=Clock(0, 60_000),
        near=1.0,
        far=2.0,
        frames=Frames(
            images, Exposure(opens, opens + 5_000), np.zeros(6, np.int64), tuple("abcdef")
        ),
        events=EventStream(none, none, t_us, np.ones(len(t_us), np.int8), 40, 30),
        split=Split(np.arange(6), np.zeros(0, np.int64)),
    )


@pytest.mark.parametrize("quality", ["pictures", "events"])
def test_the_more_blurred_the_less_a_frame_is_worth(quality: str):
    weights = frame_weights(walk(), quality)
    order = np.argsort(BLUR, kind="stable")
    assert (np.diff(weights[order]) <= 0).all()
    assert weights[0] == 1
    assert weights.min() >= LEAST


def test_events_tell_where_there_are_any():
    capture = walk()
    assert np.array_equal(frame_weights(capture, "auto"), frame_weights(capture, "events"))
    alone = replace(capture, events=None)
    assert np.array_equal(frame_weights(alone, "auto"), frame_weights(alone, "pictures"))


def test_frames_are_compared_with_their_neighbours_only():
    """A dark room after a bright one is not blurred."""
    capture = walk()
    frames = capture.needed_frames
    images = np.concatenate([frames.images[[0] * 12], frames.images[[0] * 12] // 4])
    opens = np.arange(24) * 1_000
    long = replace(
        capture,
        events=None,
        frames=Frames(images, Exposure(opens, opens), np.zeros(24, np.int64), ("x",) * 24),
        split=Split(np.arange(24), np.zeros(0, np.int64)),
    )
    weights = frame_weights(long, "pictures")
    assert weights[-1] == 1
    assert weights[12] < 0.2
