"""Two views of a scene, compared without knowing their poses, and judged by poses claimed for them.

Details are matched by description alone and kept if some geometry of two views explains them. Then
the poses and the lens of a capture are asked whether they agree: each match must lie on the line
that they say. How far it is off, in px, is the *Sampson distance*.

Source: Hartley and Zisserman, *Multiple View Geometry* (2003), sections 9.6, 11.4 and 12.2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from sharpfield.core.camera import Camera

MOST_FEATURES = 3000
FAINTEST = 0.015
RATIO = 0.8
"""Best difference of two descriptions, relative to the second best."""
TOLERANCE_PX = 2.0
"""Distance from the line that any geometry of two views says."""
LEAST_MATCHES = 16


@dataclass(frozen=True)
class Details:
    """Features of one image."""

    xy: Float64[np.ndarray, "m 2"]
    """In px, the centre of the first one at 0.5."""
    about: Float32[np.ndarray, "m 128"]


@dataclass(frozen=True)
class PairMatches:
    """What two images both show."""

    pair: tuple[int, int]
    xy: Float64[np.ndarray, "m 2 2"]
    """In the first and in the second image."""

    def __len__(self) -> int:
        """How many details."""
        return len(self.xy)


def find_details(images: UInt8[np.ndarray, "n h w c"]) -> list[Details]:
    """Features of each image."""
    sift = cv2.SIFT_create(  # pyright: ignore
        MOST_FEATURES, contrastThreshold=FAINTEST, enable_precise_upscale=True
    )
    found = []
    for image in images:
        grey = np.ascontiguousarray(image.mean(-1).round().astype(np.uint8))
        points, about = sift.detectAndCompute(grey, None)
        xy = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
        about = np.zeros((0, 128), np.float32) if about is None else about
        _, first = np.unique(xy, axis=0, return_index=True)
        root = np.sqrt(about / np.maximum(about.sum(-1, keepdims=True), 1e-9))
        found.append(Details(xy[first], root[first].astype(np.float32)))
    return found


def match_pairs(
    details: Sequence[Details], pairs: Sequence[tuple[int, int]], *, seed: int = 0
) -> list[PairMatches]:
    """Matches of each pair that some geometry of two views explains, unless they are few."""
    cv2.setRNGSeed(seed)
    found = []
    for pair in pairs:
        one, two = (details[i] for i in pair)
        rows = _alike(one.about, two.about)
        if len(rows) < LEAST_MATCHES:
            continue
        xy = np.stack([one.xy[rows[:, 0]], two.xy[rows[:, 1]]], 1)
        good = _of_one_geometry(xy)
        if good is None or good.sum() < LEAST_MATCHES:
            continue
        found.append(PairMatches(pair, xy[good[:, 0] > 0]))
    return found


def _of_one_geometry(xy: Float64[np.ndarray, "m 2 2"]) -> UInt8[np.ndarray, "m 1"] | None:
    """Which matches the best geometry of two views explains; None if there is none."""
    for method in (cv2.USAC_MAGSAC, cv2.FM_RANSAC):
        try:
            return cv2.findFundamentalMat(
                xy[:, 0], xy[:, 1], method, TOLERANCE_PX, 0.999, 5000
            )[1]  # fmt: skip
        except cv2.error:  # an assertion of OpenCV 5 fails where a plane explains most
            continue
    return None


def sampson_px(
    matches: PairMatches,
    camera: Camera,
    poses: Float64[np.ndarray, "n 3 4"],
) -> Float64[np.ndarray, "m"]:
    """How far matches are from the lines that poses and lens say."""
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


def _alike(
    one: Float32[np.ndarray, "m 128"], two: Float32[np.ndarray, "k 128"]
) -> Int64[np.ndarray, "r 2"]:
    """Rows that are each other's best match, clearly better than the second best."""
    if len(one) < 2 or len(two) < 2:
        return np.zeros((0, 2), np.int64)
    unlike = 2 - 2 * np.minimum(one @ two.T, 1)
    best = unlike.argmin(-1)
    two_least = np.partition(unlike, 1, axis=-1)[:, :2]
    clear = two_least[:, 0] < RATIO**2 * two_least[:, 1]
    mutual = unlike.argmin(0)[best] == np.arange(len(one))
    rows = np.flatnonzero(clear & mutual)
    return np.stack([rows, best[rows]], -1)


def _on_plane(camera: Camera, xy: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "m 3"]:
    """Directions with a z of one."""
    ray = camera.direction(torch.from_numpy(np.ascontiguousarray(xy))).numpy()
    return ray / ray[:, 2:]
