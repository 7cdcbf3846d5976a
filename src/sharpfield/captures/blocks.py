"""A long capture in blocks, each learned on its own: here, or by as many machines as there are.

Space is cut into slabs, across the direction in which the capture is longest, so that each is seen
by about as many pixels. A block learns from the training frames that see enough of its slab, or of
what lies close to it: blocks overlap. Nothing else about the capture changes, so that models of
all blocks live in the same world, and each keeps what lies in its own slab when they are merged.

Source: block-wise training as in Block-NeRF (CVPR 2022) and VastGaussian (CVPR 2024).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError

PROBES = 8
"""Pixels that are asked for what a frame sees, along each axis of the image."""

SHARE = 0.1
"""Part of what a frame sees that has to be in a block's slab for the block to learn from it."""

OVERLAP = 0.15
"""How far a slab reaches into its neighbours when frames are chosen, relative to its own width."""


@dataclass(frozen=True)
class Block:
    """A slab of space: what lies between two parallel planes, in the world of the capture."""

    index: int
    count: int
    across: Float64[np.ndarray, "3"]
    """Unit vector from plane to plane."""
    low: float
    """Where the slab begins along it; -inf for the first."""
    high: float

    def holds(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Which points lie in the slab: each point lies in exactly one."""
        along = points @ self.across
        return (along >= self.low) & (along < self.high)


def parsed(text: str) -> tuple[int, int]:
    """Number and count of a block, from "2/4": the second of four.

    Raises:
        OptionError: It is not of this form.
    """
    first, _, second = text.partition("/")
    if not (first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second)):
        raise OptionError("not a block", got=text, do="write 1/4 for the first of four")
    return int(first) - 1, int(second)


def blocks_of(capture: Capture, count: int) -> list[Block]:
    """The slabs of a capture, in order.

    Args:
        capture: With frames.
        count: How many.
    """
    seen = _seen(capture).reshape(-1, 3)
    middle = seen.mean(0)
    across = np.linalg.svd(seen - middle, full_matrices=False)[2][0]
    across = across * np.sign(across[np.argmax(np.abs(across))])
    cuts = np.quantile(seen @ across, np.arange(1, count) / count)
    ends = [-np.inf, *cuts.tolist(), np.inf]
    return [Block(i, count, across, ends[i], ends[i + 1]) for i in range(count)]


def limited(capture: Capture, block: Block) -> Capture:
    """The capture with those frames alone in its split that see enough of a block.

    Raises:
        CaptureError: No training frame does.
    """
    frames = np.concatenate([capture.split.train, capture.split.test])
    along = _seen(capture) @ block.across
    width = min(np.ptp(along), block.high - block.low)
    reach = OVERLAP * width
    near = (along >= block.low - reach) & (along < block.high + reach)
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
    """Points that the frames of the split see, training frames first; unknown ones repeat."""
    chosen = np.concatenate([capture.split.train, capture.split.test])
    poses = capture.frame_pose(chosen).detach().double().numpy()
    rays, depth = _probed(capture, chosen)
    local = depth[..., None] * rays
    return local @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]


def _probed(
    capture: Capture, chosen: np.ndarray
) -> tuple[Float64[np.ndarray, "q 3"], Float64[np.ndarray, "m q"]]:
    """Some directions in camera axes, with a z of 1, and the depth of each in each frame.

    It is that of the depth camera, if there is one; else half way, in inverse depth, between the
    capture's nearest and farthest.
    """
    camera = capture.camera if capture.depth is None else capture.depth.camera
    place = (np.arange(PROBES) + 0.5) / PROBES
    xy = np.stack(np.meshgrid(place * camera.width, place * camera.height), -1).reshape(-1, 2)
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
