"""Blocks of a long capture: slabs that part space, and the frames that see them."""

from dataclasses import replace

import numpy as np
import pytest

from sharpfield.captures.splits import blocks_of, parse_block, restrict_to_block
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import DepthMaps, Exposure, Frames
from sharpfield.geometry.trajectory import Still

CAMERA = Camera(16, 12, 12.0, 12.0, 8.0, 6.0)
FRAMES = 40


def corridor(*, depth: bool = True) -> Capture:
    """A camera that goes 20 units to the right along a wall 2 units away."""
    poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 20, FRAMES)
    at = np.arange(FRAMES) * 1000
    maps = DepthMaps(np.full((FRAMES, 12, 16), 2000, np.uint16), CAMERA)
    numbers = np.arange(FRAMES)
    return Capture(
        camera=CAMERA,
        trajectory=Still(poses),
        clock=Clock(0, 1000 * FRAMES),
        near=1.0,
        far=4.0,
        frames=Frames(
            np.zeros((FRAMES, 12, 16, 1), np.uint8),
            Exposure(at, at),
            numbers,
            tuple(map(str, numbers)),
        ),
        depth=maps if depth else None,
        split=Split(numbers[numbers % 5 > 0], numbers[::5]),
    )


@pytest.mark.parametrize("depth", [True, False])
def test_slabs_part_space_across_its_longest_direction(depth: bool):
    blocks = blocks_of(corridor(depth=depth), 3)
    points = np.random.default_rng(0).normal(0, 30, (1000, 3))
    assert (np.sum([block.contains(points) for block in blocks], axis=0) == 1).all()
    for block in blocks:
        assert abs(block.normal[0]) > 0.99
    assert np.diff([block.low for block in blocks]).min() > 0


def test_each_block_learns_from_the_frames_that_see_it_and_neighbours_share_some():
    capture = corridor()
    left, right = (restrict_to_block(capture, block).split for block in blocks_of(capture, 2))
    train = set(capture.split.train.tolist())
    assert set(left.train.tolist()) | set(right.train.tolist()) == train
    shared = set(left.train.tolist()) & set(right.train.tolist())
    assert 2 <= len(shared) < len(train) / 2
    assert 0 in left.test and 0 not in right.test
    assert left.train.max() < 30 and right.train.min() > 10


def test_nothing_else_changes():
    capture = corridor()
    part = restrict_to_block(capture, blocks_of(capture, 2)[0])
    assert part.frames is capture.frames and part.trajectory is capture.trajectory


def test_one_block_is_everything():
    capture = corridor()
    (block,) = blocks_of(capture, 1)
    assert np.array_equal(restrict_to_block(capture, block).split.train, capture.split.train)


def test_a_block_that_nobody_sees_is_an_error():
    capture = corridor()
    block = replace(blocks_of(capture, 2)[0], low=100.0, high=110.0)
    with pytest.raises(CaptureError, match="no training frame sees this block"):
        restrict_to_block(capture, block)


@pytest.mark.parametrize("text", ["", "2", "0/2", "3/2", "a/b", "1/", "-1/2"])
def test_what_is_no_block_is_said(text: str):
    assert parse_block("2/4") == (1, 4)
    with pytest.raises(OptionError, match="not a block"):
        parse_block(text)
