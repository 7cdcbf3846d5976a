"""SIFT features of images, and matches between two images.

A *feature* is a position with a *descriptor* of its surroundings, a unit vector. Two features match
if each is the best for the other, clearly better than the second best (*ratio test*).

Sources: Lowe, "Distinctive image features from scale-invariant keypoints" (IJCV 2004); for root
descriptors Arandjelovic and Zisserman, "Three things everyone should know to improve object
retrieval" (CVPR 2012).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

RATIO = 0.8
"""Best difference of two descriptors, relative to the second best."""


@dataclass(frozen=True)
class Features:
    """Of one image."""

    xy: Float64[np.ndarray, "m 2"]
    """In px, the centre of the first pixel at 0.5."""
    descriptors: Float32[np.ndarray, "m 128"]
    """Of unit length."""


def sift_features(
    images: Iterable[UInt8[np.ndarray, "h w"]], *, most: int, contrast: float, root: bool = False
) -> list[Features]:
    """SIFT features of each image.

    Args:
        images: Grey, as a display shows them.
        most: Maximum number of features of an image.
        contrast: Least contrast of a feature; OpenCV's own is 0.04.
        root: Square roots of the descriptors (RootSIFT), whose differences ask less of few large
            bins.
    """
    sift = _detector(most, contrast)
    found: list[Features] = []
    for image in images:
        points, raw = sift.detectAndCompute(np.ascontiguousarray(image), None)
        xy = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
        _, first = np.unique(xy, axis=0, return_index=True)  # one per position, not per orientation
        descriptors = np.zeros((0, 128)) if raw is None else np.asarray(raw, np.float32)[first]
        length = np.linalg.norm(descriptors, 1 if root else 2, axis=-1, keepdims=True)
        descriptors = descriptors / np.maximum(length, 1e-9)
        descriptors = np.sqrt(descriptors) if root else descriptors
        found.append(Features(xy[first], descriptors.astype(np.float32)))
    return found


def _detector(most: int, contrast: float) -> Any:
    import cv2

    return cv2.SIFT_create(  # pyright: ignore
        most, contrastThreshold=contrast, enable_precise_upscale=True
    )


def squared_differences(one: Features, other: Features) -> Float32[np.ndarray, "m k"]:
    """Of the descriptors of two images, 0...2."""
    return 2 - 2 * np.minimum(one.descriptors @ other.descriptors.T, 1)


def mutual_matches(difference: Float[np.ndarray, "m k"]) -> Int64[np.ndarray, "r 2"]:
    """Rows and columns that are each other's best match and pass the ratio test.

    Args:
        difference: Squared difference of descriptors; infinite where a match is impossible.
    """
    if not difference.size:
        return np.zeros((0, 2), np.int64)
    there, back = _clear_best(difference), _clear_best(difference.T)
    rows = np.flatnonzero(there >= 0)
    rows = rows[back[there[rows]] == rows]
    return np.stack([rows, there[rows]], -1)


def _clear_best(difference: Float[np.ndarray, "m k"]) -> Int64[np.ndarray, "m"]:
    """The column that differs least from each row, -1 unless it passes the ratio test."""
    every, best = np.arange(len(difference)), difference.argmin(-1)
    least = difference[every, best]
    others = difference.copy()
    others[every, best] = np.inf
    return np.where(np.isfinite(least) & (least < RATIO**2 * others.min(-1)), best, -1)
