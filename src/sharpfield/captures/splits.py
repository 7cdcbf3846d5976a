"""Which frames are trained on: rules to hold out test frames, and blocks of a long capture.

Published data sets hold out test frames by a rule, written `every:8` (frames 0, 8, 16, ...),
`train:5` (all but frames 0, 5, 10, ...), `last:5` or `none`.

A long capture is split into blocks that are trained separately, on one or several computers. Space
is cut into slabs perpendicular to the principal axis of the visible scene, so that each slab is
seen by about the same number of pixels. A block is trained on the training frames that see enough
of its slab or of its margins: blocks overlap. Nothing else about the capture changes, so the models
of all blocks share one world, and merging keeps of each model what lies in its own slab.

Source: block-wise training as in Block-NeRF (CVPR 2022) and VastGaussian (CVPR 2024).
"""

import re
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from sharpfield.core.capture import Capture, Split
from sharpfield.core.errors import CaptureError, OptionError

PROBES = 8
"""Number of probe pixels along each image axis, whose depth gives the visible points."""

SHARE = 0.1
"""Minimum share of what a frame sees that must lie in a slab for its block to use the frame."""

OVERLAP = 0.15
"""Margin of a slab on both sides when frames are chosen, relative to its width."""


@dataclass(frozen=True)
class Block:
    """A slab of space between two parallel planes, in world coordinates of the capture."""

    index: int
    count: int
    normal: Float64[np.ndarray, "3"]
    """Unit normal of both planes."""
    low: float
    """Position of the first plane along the normal; -inf for the first slab."""
    high: float
    """Position of the second plane; inf for the last slab."""

    def contains(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Which points lie in the slab: each point lies in exactly one slab."""
        along = points @ self.normal
        return (along >= self.low) & (along < self.high)


def parse_block(text: str) -> tuple[int, int]:
    """Index (from 0) and number of blocks, from "2/4": the second of four.

    Raises:
        OptionError: The text is not of this form.
    """
    first, _, second = text.partition("/")
    if not (first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second)):
        raise OptionError("not a block", got=text, do="write 1/4 for the first of four")
    return int(first) - 1, int(second)


def blocks_of(capture: Capture, count: int) -> list[Block]:
    """The blocks of a capture, in the order of their slabs.

    Args:
        capture: With frames.
        count: Number of blocks.
    """
    seen = _seen(capture).reshape(-1, 3)
    middle = seen.mean(0)
    normal = np.linalg.svd(seen - middle, full_matrices=False)[2][0]  # first principal axis
    normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
    cuts = np.quantile(seen @ normal, np.arange(1, count) / count)
    ends = [-np.inf, *cuts.tolist(), np.inf]
    return [Block(i, count, normal, ends[i], ends[i + 1]) for i in range(count)]


def restrict_to_block(capture: Capture, block: Block) -> Capture:
    """The capture with only those frames in its split that see enough of a block.

    Raises:
        CaptureError: No training frame sees enough of it.
    """
    frames = np.concatenate([capture.split.train, capture.split.test])
    along = _seen(capture) @ block.normal  # [m, q]
    width = min(np.ptp(along), block.high - block.low)
    margin = OVERLAP * width
    near = (along >= block.low - margin) & (along < block.high + margin)
    kept = frames[near.mean(1) >= SHARE]
    train = capture.split.train[np.isin(capture.split.train, kept)]
    if not len(train):
        raise CaptureError(
            "no training frame sees this block",
            where=f"block {block.index + 1}/{block.count} of {capture.name}",
            do="cut the capture into fewer blocks",
        )
    test = capture.split.test[np.isin(capture.split.test, kept)]
    return replace(capture, split=replace(capture.split, train=train, test=test))


def _seen(capture: Capture) -> Float64[np.ndarray, "m q 3"]:
    """World points at probe pixels of the frames of the split, training frames first."""
    chosen = np.concatenate([capture.split.train, capture.split.test])
    poses = capture.frame_pose(chosen).detach().double().numpy()
    rays, depth = _probed(capture, chosen)
    local = depth[..., None] * rays
    return local @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]  # [m, q, 3]


def _probed(
    capture: Capture, chosen: np.ndarray
) -> tuple[Float64[np.ndarray, "q 3"], Float64[np.ndarray, "m q"]]:
    """Directions of probe pixels in camera axes, scaled to z = 1, and their depth in each frame.

    Depths come from the depth camera if there is one, with the median where unknown; else they are
    the harmonic mean of near and far.
    """
    camera = capture.camera if capture.depth is None else capture.depth.camera
    share = (np.arange(PROBES) + 0.5) / PROBES
    xy = np.stack(np.meshgrid(share * camera.width, share * camera.height), -1).reshape(-1, 2)
    rays = camera.direction(torch.from_numpy(xy)).numpy()
    rays = rays / rays[:, 2:]
    usual = 2 / (1 / capture.near + 1 / capture.far)
    depth = np.full((len(chosen), len(xy)), usual)
    if capture.depth is not None:
        column, row = xy.astype(np.int64).T
        for i, frame in enumerate(chosen):
            found = capture.depth.at(int(frame))[row, column].astype(np.float64)
            known = found > 0
            if known.any():
                depth[i] = np.where(known, found, np.median(found[known]))
    return rays, depth


RULE = re.compile(r"(?P<kind>every|train|last):(?P<number>[1-9][0-9]*)|none")


def split_by_rule(count: int, rule: str) -> Split:
    """The training frames and the held-out frames among `count` frames.

    Raises:
        OptionError: The rule is malformed.
        CaptureError: It leaves no training frames.
    """
    match = RULE.fullmatch(rule)
    if match is None:
        raise OptionError(
            "unknown hold-out rule", got=rule, do="write every:8, train:5, last:5 or none"
        )
    every = np.arange(count, dtype=np.int64)
    number = int(match["number"] or 0)
    if match["kind"] == "every":
        held_out = every % number == 0
    elif match["kind"] == "train":
        held_out = every % number != 0
    else:
        held_out = every >= count - number
    if held_out.all():
        raise CaptureError(
            "no training frame is left",
            got=f"{count} frames, hold-out rule {rule}",
            do="hold out fewer frames",
        )
    return Split(train=every[~held_out], test=every[held_out])
