"""Epipolar geometry of two views: matches found without poses, and poses checked against them.

Features are matched by their descriptors alone and kept if one fundamental matrix explains them.
Then the poses and the lens of a capture are checked: each match must lie on the *epipolar line*
that they predict. Its distance from the line, in px, is the *Sampson distance*.

Source: Hartley and Zisserman, *Multiple View Geometry* (2003), sections 9.6, 11.4 and 12.2.

SIFT features of images, and matches between two images.

A *feature* is a position with a *descriptor* of its surroundings, a unit vector. Two features match
if each is the best for the other, clearly better than the second best (*ratio test*).

Sources: Lowe, "Distinctive image features from scale-invariant keypoints" (IJCV 2004); for root
descriptors Arandjelovic and Zisserman, "Three things everyone should know to improve object
retrieval" (CVPR 2012).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8

from sharpfield.core.camera import Camera

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


MAX_FEATURES = 3000
"""Of one image."""
MIN_CONTRAST = 0.015
"""Of a feature."""
TOLERANCE_PX = 2.0
"""Distance from the epipolar line of the fundamental matrix that is fitted to matches."""
MIN_MATCHES = 16


@dataclass(frozen=True)
class PairMatches:
    """Matched features of two images."""

    pair: tuple[int, int]
    xy: Float64[np.ndarray, "m 2 2"]
    """In the first and in the second image."""

    def __len__(self) -> int:
        """How many matches."""
        return len(self.xy)


def find_features(images: UInt8[np.ndarray, "n h w c"]) -> list[Features]:
    """SIFT features of each image, with root descriptors."""
    grey = (image.mean(-1).round().astype(np.uint8) for image in images)
    return sift_features(grey, most=MAX_FEATURES, contrast=MIN_CONTRAST, root=True)


def match_pairs(
    features: Sequence[Features], pairs: Sequence[tuple[int, int]], *, seed: int = 0
) -> list[PairMatches]:
    """Matches of each pair that one fundamental matrix explains; pairs with few are left out.

    Args:
        features: Of each image.
        pairs: Images to compare, by index.
        seed: Of the random sampling in the fit.
    """
    import cv2

    cv2.setRNGSeed(seed)
    found: list[PairMatches] = []
    for pair in pairs:
        one, two = (features[i] for i in pair)
        rows = mutual_matches(squared_differences(one, two))
        if len(rows) < MIN_MATCHES:
            continue
        xy = np.stack([one.xy[rows[:, 0]], two.xy[rows[:, 1]]], 1)
        good = _epipolar_inliers(xy)
        if good is None or good.sum() < MIN_MATCHES:
            continue
        found.append(PairMatches(pair, xy[good[:, 0] > 0]))
    return found


def _epipolar_inliers(xy: Float64[np.ndarray, "m 2 2"]) -> UInt8[np.ndarray, "m 1"] | None:
    """Which matches the best fundamental matrix explains; None if there is none."""
    import cv2

    for method in (cv2.USAC_MAGSAC, cv2.FM_RANSAC):
        try:
            return cv2.findFundamentalMat(
                xy[:, 0], xy[:, 1], method, TOLERANCE_PX, 0.999, 5000
            )[1]  # fmt: skip
        except cv2.error:  # an assertion of OpenCV 5 fails where a plane explains most
            continue
    return None


def sampson_px(
    matches: PairMatches, camera: Camera, poses: Float64[np.ndarray, "n 3 4"]
) -> Float64[np.ndarray, "m"]:
    """Sampson distance of matches from the epipolar lines that poses and lens predict."""
    rays = [_on_plane(camera, matches.xy[:, i]) for i in (0, 1)]
    one, two = (poses[i] for i in matches.pair)
    turn = two[:, :3].T @ one[:, :3]
    shift = two[:, :3].T @ (one[:, 3] - two[:, 3])
    length = np.linalg.norm(shift)
    cross = np.cross(np.eye(3), shift / max(length, 1e-12))
    essential = -cross @ turn
    line, back = rays[0] @ essential.T, rays[1] @ essential
    off = np.abs((rays[1] * line).sum(-1))
    steep = np.sqrt((line[:, :2] ** 2).sum(-1) + (back[:, :2] ** 2).sum(-1))
    return off / np.maximum(steep, 1e-12) * np.sqrt(2) * camera.fx_px


def depths_of(
    matches: PairMatches, camera: Camera, poses: Float64[np.ndarray, "n 3 4"]
) -> tuple[Float64[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
    """Depth of matches in the first view where their rays meet, and where that can be trusted."""
    origin = poses[list(matches.pair), :, 3]
    rays = [_on_plane(camera, matches.xy[:, i]) @ poses[matches.pair[i], :, :3].T for i in (0, 1)]
    unit = [ray / np.linalg.norm(ray, axis=-1, keepdims=True) for ray in rays]
    cosine = (unit[0] * unit[1]).sum(-1)
    apart = origin[1] - origin[0]
    along = (apart @ unit[0].T - cosine * (apart @ unit[1].T)) / np.maximum(1 - cosine**2, 1e-9)
    depth = along * (unit[0] @ poses[matches.pair[0], :, 2])
    return depth, (np.arccos(np.clip(cosine, -1, 1)) > np.deg2rad(1.0)) & (depth > 0)


def pairs_apart(poses: Float64[np.ndarray, "n 3 4"], *, most: int) -> list[tuple[int, int]]:
    """Pairs of images with clear parallax: of each, the ones at middling distance."""
    centre = poses[:, :, 3]
    away = np.linalg.norm(centre[:, None] - centre, axis=-1)
    first, second = np.triu_indices(len(poses), 1)
    order = np.argsort(-away[first, second], kind="stable")
    chosen = order[: max(2 * most, 1)][::2] if len(order) > most else order
    return [(int(first[i]), int(second[i])) for i in chosen[:most]]


def _on_plane(camera: Camera, xy: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "m 3"]:
    """Directions with a z of one."""
    ray = camera.direction(torch.tensor(xy)).numpy()
    return ray / ray[:, 2:]
