"""Motion blur of a frame in px, measured from the events of its exposure.

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

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.events.threshold import thresholds_of

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
