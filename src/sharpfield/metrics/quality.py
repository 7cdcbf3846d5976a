"""Sharpness of the frames of a video, independent of their content, and training weights from it.

The *response* of an image is the second derivative of its local mean. Its variance falls with blur,
but also depends on the content. So two frames are compared only where they show the same (their
*overlap*), and comparisons of neighbours are combined to one *score* for each frame. Scores are
relative: they have no unit. *Weights* compare a frame with those around it and are 1 on average.

Source: Hybrid Neural Rendering (CVPR 2023), content-aware blur detection; its released code for
the numbers. There, the response is a Laplacian, overlaps come from learned optical flow, each frame
is compared with the next, and ratios are multiplied along the video (`chained`), which drifts. Here
(`reconciled`), responses across and down are separate, since motion blur has a direction; overlaps
come from depth where it is known, else from DIS flow; and scores are a least-squares fit to
comparisons with several neighbours and, with a small weight, to the image's own variance.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.frames import Frames
from sharpfield.metrics.blur_cues import Overlap, depth_overlap, event_blur, flow_overlap
from sharpfield.storage.disk_cache import cached_arrays

WIDTH = 640
"""Images are compared at this width, in px."""
SMOOTHED, SMOOTHED_PUBLISHED = 3, 5
"""Side of the mean filter, in px."""
WINDOW, STRIDE = 10, 5
"""Frames within which a weight compares, and the step from one such window to the next."""
NEIGHBOURS = 4
"""Each frame is compared with so many after it."""
ANCHORS = {"depth": 0.05, "flow": 0.2}
"""Weight of an image's own variance against one comparison; flow is less accurate than depth."""
LEAST_SHARE = 0.02
"""Comparisons over a smaller fraction of the image are left out."""
TINY = 1e-9

Means = Literal["auto", "depth", "flow"]
"""Source of overlaps; "auto" is depth where the capture has it, else flow."""
Way = Literal["reconciled", "published"]
Judge = Literal["published", "auto", "images", "events"]
"""What weighs frames: images as published; events where there are any, else images; images; events.
"""
Source = Literal["auto", "images", "events"]
"""Source of the sharpness of frames; "auto" is events where the capture has them, else images."""
SOFTEST_PX = 0.5
"""Blur of any lens and pixel, added to the measured motion blur."""


Image = UInt8[np.ndarray, "h w"]
Response = Float32[np.ndarray, "h w"]
Responses = Sequence[Response] | Mapping[int, Response]
Seen = Callable[[int, int, Image, Image], Overlap]
"""The overlap of two frames, given by their positions and images."""


@dataclass(frozen=True)
class Comparison:
    """Variance of the responses of two frames over what both show."""

    i: int
    """Position of the first frame among those compared."""
    j: int
    first: float
    second: float
    share: float
    """Overlap as a fraction of the image."""


@dataclass(frozen=True)
class Quality:
    """Scores and weights of some frames."""

    frames: Int64[np.ndarray, "m"]
    """Their indices."""
    scores: Float64[np.ndarray, "m"]
    """Larger is sharper."""
    weights: Float64[np.ndarray, "m"]


def frame_quality(
    capture: Capture,
    *,
    frames: Int64[np.ndarray, "m"] | None = None,
    overlap: Means = "auto",
    way: Way = "reconciled",
) -> Quality:
    """Scores and weights of frames, from their images.

    Args:
        capture: A video: frames are compared with those that follow.
        frames: Which, in order of time; by default the training frames.
        overlap: How to find the overlap of two frames.
        way: "published" compares each frame with the next only and multiplies.

    Raises:
        OptionError: `overlap` is "depth", and there is none.
    """
    chosen = capture.split.train if frames is None else frames
    if overlap == "depth" and capture.depth is None:
        raise OptionError("the capture has no depth", where=capture.name, do="take overlap flow")
    by_depth = capture.depth is not None and overlap != "flow"

    def seen(i: int, j: int, one: Image, other: Image) -> Overlap:
        if by_depth:
            return depth_overlap(capture, int(chosen[i]), int(chosen[j]), one.shape[::-1])
        return flow_overlap(one, other)

    images = (grey(capture.needed_frames, int(i)) for i in chosen)
    if way == "published":
        scores = _published(images, seen)
    else:
        scores = _reconciled(images, seen, anchor=ANCHORS["depth" if by_depth else "flow"])
    return Quality(chosen, scores, window_weights(scores))


def event_quality(capture: Capture, *, frames: Int64[np.ndarray, "m"] | None = None) -> Quality:
    """Scores and weights of frames, from the events of their exposures.

    A score is the inverse of the blur in px, see `metrics.blur_from_events`.

    Raises:
        CaptureError: There are no events, or they are of several cameras.
    """
    chosen = capture.split.train if frames is None else frames
    scores = 1 / (SOFTEST_PX + event_blur(capture, frames=chosen))
    return Quality(chosen, scores, window_weights(scores))


def quality_weights(capture: Capture, *, source: Source = "auto") -> Float64[np.ndarray, "n"]:
    """A weight for each frame: about 1 on average over training frames, and 1 for the others.

    Args:
        capture: With frames, and for "events" with events.
        source: Of the sharpness.

    Raises:
        CaptureError: There are no events, or they are of several cameras.
    """
    with_events = capture.events is not None and capture.events.track is None
    if source == "events" or (source == "auto" and with_events):
        found = event_quality(capture)
    else:
        found = frame_quality(capture)
    weights = np.ones(len(capture.needed_frames))
    weights[found.frames] = found.weights
    return weights


def frame_weights(capture: Capture, judge: Judge) -> Float64[np.ndarray, "n"]:
    """A weight for each frame: about 1 on average over training frames, and 1 for the others.

    Weights that come from images take long for long captures and are cached on disk.

    Raises:
        CaptureError: `judge` is "events", and there are none.
    """
    by_events = capture.events is not None and capture.events.track is None
    if judge == "events" or (judge == "auto" and by_events):
        return quality_weights(capture, source="events")
    parameters = {"judge": judge}
    found = cached_arrays(
        capture, "quality", parameters, lambda: {"weights": _seen(capture, judge)}
    )
    return found["weights"]


def _seen(capture: Capture, judge: Judge) -> Float64[np.ndarray, "n"]:
    if judge != "published":
        return quality_weights(capture, source="images")
    weights = np.ones(len(capture.needed_frames))
    found = frame_quality(capture, way="published")
    weights[found.frames] = found.weights
    return weights


def _published(images: Iterable[Image], seen: Seen) -> Float64[np.ndarray, "m"]:
    current, following, before = [], [], None
    for j, image in enumerate(images):
        response = laplacian(image)
        if before is not None:
            both = seen(j - 1, j, before[0], image)
            pair = compared(j - 1, j, {j - 1: before[1], j: response}, both)
            current.append(pair.first)
            following.append(pair.second)
        before = image, response
    own = 0.0 if before is None else float(before[1].astype(np.float64).var())
    return chained(np.array([*current, own]), np.array([*following, own]))


def _reconciled(images: Iterable[Image], seen: Seen, *, anchor: float) -> Float64[np.ndarray, "m"]:
    own: tuple[list[float], list[float]] = ([], [])
    pairs: tuple[list[Comparison], list[Comparison]] = ([], [])
    # Only the last few of a long video are held at once.
    last: deque[tuple[int, Image, tuple[Response, Response]]] = deque(maxlen=NEIGHBOURS)
    for j, image in enumerate(images):
        bent = bending(image)
        for i, earlier, bent_earlier in last:
            both = seen(i, j, earlier, image)
            for way in (0, 1):
                responses = {i: bent_earlier[way], j: bent[way]}
                pairs[way].append(compared(i, j, responses, both))
        for way in (0, 1):
            own[way].append(float(bent[way].astype(np.float64).var()))
        last.append((j, image, bent))
    scores = [reconciled(np.array(own[way]), pairs[way], anchor=anchor) for way in (0, 1)]
    return np.sqrt(scores[0] * scores[1])


def grey(frames: Frames, frame: int) -> UInt8[np.ndarray, "h w"]:
    """A frame for comparison: stored values, grey, 640 px wide."""
    image = np.asarray(frames.images[frame])
    if image.dtype != np.uint8:
        image = np.rint(image * (255.0 / frames.white)).astype(np.uint8)
    flat = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if frames.channels == 3 else image[..., 0]
    height = round(WIDTH * frames.height / frames.width)
    larger = frames.width < WIDTH
    return cv2.resize(
        flat, (WIDTH, height), interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA
    )


def laplacian(image: Image) -> Response:
    """Laplacian (four neighbours) of the mean over 5x5 px, signed: the published response."""
    smooth = cv2.blur(image.astype(np.float32), (SMOOTHED_PUBLISHED, SMOOTHED_PUBLISHED))
    return cv2.Laplacian(smooth, cv2.CV_32F, ksize=1)


def bending(image: Image) -> tuple[Response, Response]:
    """Second derivatives of the mean over 3x3 px, across and down."""
    smooth = cv2.blur(image.astype(np.float32), (SMOOTHED, SMOOTHED))
    return cv2.Sobel(smooth, cv2.CV_32F, 2, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 2)


def compared(i: int, j: int, responses: Responses, both: Overlap) -> Comparison:
    """Variance of the responses of two frames over their overlap.

    Args:
        i: The first.
        j: The second.
        responses: Of both, by these numbers.
        both: The overlap of the first frame with the second.
    """
    if not len(both.here):
        return Comparison(i, j, 0.0, 0.0, 0.0)
    one, other = (
        responses[k][place[:, 0], place[:, 1]].astype(np.float64)
        for k, place in ((i, both.here), (j, both.there))
    )
    return Comparison(i, j, float(one.var()), float(other.var()), both.share)


def chained(
    current: Float64[np.ndarray, "m"], following: Float64[np.ndarray, "m"]
) -> Float64[np.ndarray, "m"]:
    """Scores from comparisons with the next frame: S_0 = c_0, S_(t+1) = S_t f_t / c_t.

    Args:
        current: Variance of each frame over its overlap with the next.
        following: Variance of the next frame over the same.
    """
    ratios = following[:-1] / current[:-1]
    return current[0] * np.cumprod(np.concatenate([[1.0], ratios]))


def reconciled(
    own: Float64[np.ndarray, "m"], comparisons: Sequence[Comparison], *, anchor: float
) -> Float64[np.ndarray, "m"]:
    """Scores that agree best with all comparisons, by least squares on their logarithms.

    Args:
        own: Variance of each whole image: a weak prior, which fixes the common scale.
        comparisons: Of any pairs of frames.
        anchor: Weight of that prior against a comparison of whole images.
    """
    system, right = np.diag(np.full(len(own), anchor)), anchor * np.log(own + TINY)
    for pair in comparisons:
        if pair.share < LEAST_SHARE or min(pair.first, pair.second) <= 0:
            continue
        ratio = np.log(pair.second / pair.first)
        ends = [pair.i, pair.j]
        system[ends, ends] += pair.share
        system[ends, ends[::-1]] -= pair.share
        right[ends] += pair.share * ratio * np.array([-1, 1])
    return np.exp(np.linalg.solve(system, right))


def window_weights(
    scores: Float64[np.ndarray, "m"], *, length: int = WINDOW, stride: int = STRIDE
) -> Float64[np.ndarray, "m"]:
    """Scores over their mean in a sliding window; windows overlap, and their weights are averaged.

    Args:
        scores: Of frames in order of time.
        length: Frames in a window; the last may have fewer.
        stride: From one window to the next.
    """
    total, times = np.zeros(len(scores)), np.zeros(len(scores))
    first = 0
    while first < len(scores):
        part = slice(first, first + length)
        total[part] += scores[part] / scores[part].mean()
        times[part] += 1
        if first + length >= len(scores):
            break
        first += stride
    return total / np.maximum(times, 1)
