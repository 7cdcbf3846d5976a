"""Overlap of two images: pixels of the same point, by depth and poses, or by optical flow.

Motion blur of a frame in px, measured from the events of its exposure.

Within a short part of an exposure the image shifts a little, and the log light of a pixel changes
by the image gradient times the shift: change = -gradient . shift. Events measure that change. The
gradient is that of the sharp image at the time, which the event double integral gives from the
blurred frame and the events. So shifts follow, block by block, by least squares; the sum of their
lengths over the exposure is the *travel*, and the blur of a frame is the mean over its blocks. No
depth, poses or other frames are needed.

Source: the optical flow constraint of Lucas and Kanade (IJCAI 1981) with events for the temporal
derivative; Pan et al., *Bringing a blurry frame alive at high frame-rate* (CVPR 2019) for the
double integral.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.events.threshold import thresholds_of

EVERY = 4
"""Stride of the pixels that are used, along both axes."""
BORDER = 20 / 640
"""Margin that is left out at each border, as a fraction of the width."""
SAME_DEPTH = 0.05
"""Depths with a smaller relative difference are of the same surface."""
FLOW_SHRINK = 2
"""Factor by which images are downscaled for optical flow."""


@dataclass(frozen=True)
class Overlap:
    """Pixels of one image, and the corresponding pixels of another."""

    here: Int64[np.ndarray, "q 2"]
    """Rows and columns."""
    there: Int64[np.ndarray, "q 2"]
    share: float
    """Fraction of the sampled pixels that are visible in both."""


def depth_overlap(capture: Capture, first: int, second: int, size: tuple[int, int]) -> Overlap:
    """Overlap of two frames, by depth and poses; occluded points do not count.

    Args:
        capture: With depth.
        first: The frame whose pixels are projected.
        second: The frame to which they are projected.
        size: Width and height of the images to compare, of the same field of view.
    """
    camera, depth = capture.camera, capture.needed_depth
    here = _lattice(size)
    scale = np.array([camera.width / size[0], camera.height / size[1]])
    xy = torch.from_numpy((here[:, ::-1] + 0.5) * scale)
    rays = camera.direction(xy)
    rays = rays / rays[:, 2:]
    measured = _looked_up(depth.at(first), depth.camera.project(rays).numpy())
    poses = capture.frame_pose(np.array([first, second])).detach().double().numpy()
    points = (rays.numpy() * measured[:, None]) @ poses[0, :, :3].T + poses[0, :, 3]
    inside = (points - poses[1, :, 3]) @ poses[1, :, :3]
    ahead = np.where(inside[:, 2:] > 0, inside, [0, 0, 1])
    seen = torch.from_numpy(ahead)
    there = np.floor(camera.project(seen).numpy() / scale)[:, ::-1].astype(np.int64)
    other = _looked_up(depth.at(second), depth.camera.project(seen).numpy())
    good = (measured > 0) & (inside[:, 2] > 0)
    good &= np.abs(other - inside[:, 2]) < SAME_DEPTH * inside[:, 2]
    return _kept(here, there, good, size)


def flow_overlap(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> Overlap:
    """Overlap of two grey images, by dense optical flow (DIS).

    Source: Kroeger et al., "Fast optical flow using dense inverse search" (ECCV 2016).
    """
    height, width = first.shape
    small = width // FLOW_SHRINK, height // FLOW_SHRINK
    find = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    one, other = (cv2.resize(p, small, interpolation=cv2.INTER_AREA) for p in (first, second))
    flow = find.calc(one, other, np.zeros((*one.shape, 2), np.float32))
    here = _lattice((width, height))
    at = np.minimum(here // FLOW_SHRINK, np.array(small)[::-1] - 1)
    shift = flow[at[:, 0], at[:, 1]] * np.array([width / small[0], height / small[1]])
    there = np.floor(here + 0.5 + shift[:, ::-1]).astype(np.int64)
    return _kept(here, there, np.ones(len(here), bool), (width, height))


def _lattice(size: tuple[int, int]) -> Int64[np.ndarray, "q 2"]:
    """Rows and columns of every `EVERY`-th pixel."""
    rows, columns = (np.arange(EVERY // 2, side, EVERY) for side in size[::-1])
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2).astype(np.int64)


def _kept(
    here: Int64[np.ndarray, "q 2"],
    there: Int64[np.ndarray, "q 2"],
    good: np.ndarray,
    size: tuple[int, int],
) -> Overlap:
    """Pairs away from the borders of both images."""
    border = round(BORDER * size[0])
    least, most = border, np.array(size)[::-1] - border
    for pixel in (here, there):
        good = good & ((pixel >= least) & (pixel < most)).all(1)
    return Overlap(here[good], there[good], float(good.mean()))


def _looked_up(
    depth: Float32[np.ndarray, "h w"], xy: Float64[np.ndarray, "q 2"]
) -> Float64[np.ndarray, "q"]:
    """Depth at the nearest pixel; 0 outside."""
    column, row = np.floor(np.clip(xy, -1, 1e6)).astype(np.int64).T
    height, width = depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.where(inside, found, 0.0).astype(np.float64)


PARTS = 16
"""Parts of an exposure."""
BLOCKS = 6
"""Blocks along the shorter side of the image."""
DARK = 0.02
"""Added to light before logarithms, as a fraction of white."""
SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian applied to the image and to the changes."""
HOLD = 0.05
"""Regularisation of a block's shift towards that of the whole image, relative to the mean squared
gradient."""


def event_blur(
    capture: Capture, *, frames: Int64[np.ndarray, "m"] | None = None
) -> Float64[np.ndarray, "m"]:
    """Mean travel in px of some frames, measured from the events of their exposures.

    Args:
        capture: With frames and events of one camera.
        frames: Which; by default the training frames.

    Raises:
        CaptureError: There are no events, or they are of several cameras.
    """
    if capture.needed_events.track is not None:
        raise CaptureError("blur from events needs a single camera", where=capture.name)
    chosen = capture.split.train if frames is None else frames
    return np.array([_travel(capture, int(frame)) for frame in chosen], np.float64)


def _travel(capture: Capture, frame: int) -> float:
    """Mean over the blocks of the summed lengths of their shifts."""
    changes = _changes(capture, frame)
    if not np.abs(changes).any():
        return 0.0
    light = _light(capture, frame)
    # Log light at the borders of the parts, relative to the first; the frame is the mean of all.
    since = np.concatenate([np.zeros_like(changes[:1]), np.cumsum(changes, 0)])
    start = np.log(light) - np.log(np.exp(0.5 * (since[1:] + since[:-1])).mean(0))
    total = 0.0
    for part, change in enumerate(changes):
        log_light = (start + 0.5 * (since[part] + since[part + 1])).astype(np.float32)
        total += float(np.linalg.norm(_shifts(log_light, change), axis=-1).mean())
    return total


def _changes(capture: Capture, frame: int) -> Float32[np.ndarray, "k h w"]:
    """Change of log light in each part of an exposure, summed from events."""
    events, camera = capture.needed_events, capture.camera
    opens, closes = capture.needed_frames.exposure.window(frame)
    inside = events.window(opens, max(closes, opens + 1))
    off, on = thresholds_of(capture)
    part = (inside.t_us - opens) * PARTS // max(closes - opens, 1)
    column = np.clip(np.floor(inside.x), 0, camera.width - 1).astype(np.int64)
    row = np.clip(np.floor(inside.y), 0, camera.height - 1).astype(np.int64)
    at = (part.clip(0, PARTS - 1) * camera.height + row) * camera.width + column
    step = np.where(np.asarray(inside.p) > 0, on, -off)
    shape = PARTS, camera.height, camera.width
    return np.bincount(at, step, int(np.prod(shape))).reshape(shape).astype(np.float32)


def _light(capture: Capture, frame: int) -> Float32[np.ndarray, "h w"]:
    """Grey linear light of a frame, never dark."""
    frames = capture.needed_frames
    stored = np.asarray(frames.images[frame]).astype(np.float32) / frames.white
    bent = {"linear": 1.0, "gamma2.2": 2.2, "srgb": 2.2}[frames.encoding]
    return (stored**bent).mean(-1) + np.float32(DARK)


def _shifts(
    log_light: Float32[np.ndarray, "h w"], change: Float32[np.ndarray, "h w"]
) -> Float64[np.ndarray, "q 2"]:
    """Shift of each block in px: least squares of change = -gradient . shift (Lucas-Kanade)."""
    smooth, changed = (
        cv2.GaussianBlur(one.astype(np.float32), (0, 0), SMOOTHING_PX)
        for one in (log_light, change)
    )
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8).astype(np.float64)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8).astype(np.float64)
    side = max(min(log_light.shape) // BLOCKS, 4)
    products = (across * across, across * down, down * down, -across * changed, -down * changed)
    xx, xy, yy, x, y = (_blocks(one, side) for one in products)
    whole = np.array([[xx.mean(), xy.mean()], [xy.mean(), yy.mean()]])
    hold = HOLD * np.trace(whole) + 1e-12
    common = np.linalg.solve(whole + 1e-6 * hold * np.eye(2), np.array([x.mean(), y.mean()]))
    system = np.stack([np.stack([xx + hold, xy], -1), np.stack([xy, yy + hold], -1)], -2)
    right = np.stack([x, y], -1) + hold * common
    return np.linalg.solve(system, right[..., None])[..., 0]


def _blocks(values: Float64[np.ndarray, "h w"], side: int) -> Float64[np.ndarray, "q"]:
    """Means over square blocks; the rest at the right and the bottom is left out."""
    rows, columns = values.shape[0] // side, values.shape[1] // side
    cut = values[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return cut.mean((1, 3)).ravel()
