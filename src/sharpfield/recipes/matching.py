"""The same detail found in two pictures whose poses are known.

A *feature* is a position with a description of its surroundings. Where a feature of one picture
can be in another is known up to its depth: on a piece of a curve, the *trace* of its ray. Only
features near the trace are compared, so that small and repeated details are matched as well.

Source: Lowe, "Distinctive image features from scale-invariant keypoints" (IJCV 2004) for features
and the ratio of the best to the second best.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from sharpfield.formation.tone import GAMMA
from sharpfield.recipes.pictures import Pictures

MOST_FEATURES = 4000
"""Of one picture."""

FAINTEST = 0.01
"""Contrast of a feature, about a third of the customary one: pictures are small and some noisy."""

NEIGHBOURS = 4
"""Other pictures each one is compared with."""

PARALLAX_RAD = np.deg2rad(1.0)
"""Least angle between two rays to a point; less leaves its depth open."""

TOWARD = 0.5
"""Least cosine between the axes of pictures that are compared."""

TOLERANCE_PX = 1.5
"""Distance of a feature from the trace."""

UNLIKE = 0.5
"""Squared difference of two descriptions, 0...2, from which on they show different things."""

RATIO = 0.8
"""Best difference of two descriptions, relative to the second best."""

SEGMENTS = 8
"""The trace is followed in so many straight pieces: lenses bend it."""


@dataclass(frozen=True)
class Features:
    """Of one picture."""

    xy: Float[np.ndarray, "m 2"]
    """In pixels, the centre of the first one at 0.5."""
    about: Float32[np.ndarray, "m 128"]
    """Descriptions of unit length."""


def find_features(pictures: Pictures) -> list[Features]:
    """Features of each picture, as a display shows it: light alone hides the dark parts."""
    sift = cv2.SIFT_create(  # pyright: ignore
        MOST_FEATURES, contrastThreshold=FAINTEST, enable_precise_upscale=True
    )
    found = []
    for light in pictures.light:
        shown = np.rint(255 * light.mean(-1) ** (1 / GAMMA)).astype(np.uint8)
        points, about = sift.detectAndCompute(shown, None)
        xy = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
        about = np.zeros((0, 128), np.float32) if about is None else about
        _, first = np.unique(xy, axis=0, return_index=True)  # one per place, not per orientation
        length = np.linalg.norm(about, axis=-1, keepdims=True)
        found.append(Features(xy[first], (about / np.maximum(length, 1e-9))[first]))
    return found


def choose_pairs(pictures: Pictures) -> list[tuple[int, int]]:
    """Pictures to compare: the nearest ones with enough parallax that look the same way."""
    centre, forward = pictures.poses[:, :, 3], pictures.poses[:, :, 2]
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    usual = 2 / (1 / pictures.near + 1 / pictures.far)
    usable = (apart > PARALLAX_RAD * usual) & (forward @ forward.T > TOWARD)
    pairs = set[tuple[int, int]]()
    for i in range(len(pictures)):
        order = np.argsort(np.where(usable[i], apart[i], np.inf), kind="stable")[:NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order if usable[i, j]}
    return sorted(pairs)


def match(
    pictures: Pictures, features: list[Features], pair: tuple[int, int]
) -> Int64[np.ndarray, "m 2"]:
    """Rows of features in two pictures that show the same detail: each the best for the other."""
    first, second = pair
    a, b = features[first], features[second]
    if not len(a.xy) or not len(b.xy):
        return np.zeros((0, 2), np.int64)
    unlike = 2 - 2 * np.minimum(a.about @ b.about.T, 1)  # squared difference
    row, column = np.nonzero(unlike < UNLIKE)
    near = _near_trace(pictures, a.xy, b.xy[column], row, pair)
    compared = np.full(unlike.shape, np.inf)
    compared[row[near], column[near]] = unlike[row[near], column[near]]
    there, back = _clear_best(compared), _clear_best(compared.T)
    rows = np.flatnonzero(there >= 0)
    rows = rows[back[there[rows]] == rows]
    return np.stack([rows, there[rows]], -1)


def _clear_best(unlike: Float[np.ndarray, "m k"]) -> Int64[np.ndarray, "m"]:
    """The column that is least unlike each row, -1 unless it is clearly so."""
    every, best = np.arange(len(unlike)), unlike.argmin(-1)
    least = unlike[every, best]
    others = unlike.copy()
    others[every, best] = np.inf
    return np.where(np.isfinite(least) & (least < RATIO**2 * others.min(-1)), best, -1)


def _near_trace(
    pictures: Pictures,
    start: Float[np.ndarray, "m 2"],
    end: Float[np.ndarray, "p 2"],
    row: Int64[np.ndarray, "p"],
    pair: tuple[int, int],
) -> Bool[np.ndarray, "p"]:
    """Which positions in the second picture lie near the trace of a ray of the first.

    Args:
        pictures: Both of them.
        start: Positions in the first picture.
        end: Positions in the second.
        row: Whose ray (row of `start`) each of them is compared with.
        pair: The two pictures.
    """
    origin, direction = pictures.poses[pair[0], :, 3], pictures.directions(start, pair[0])
    depth = 1 / np.linspace(1.25 / pictures.near, 0.8 / pictures.far, SEGMENTS + 1)
    axis = pictures.poses[pair[0], :, 2]
    far = depth / np.maximum(direction @ axis, 1e-3)[:, None]  # [m, s], along the rays
    points = origin + far[..., None] * direction[:, None]
    xy, z = pictures.project(points.reshape(-1, 3), pair[1])
    xy, ahead = xy.reshape(*far.shape, 2), z.reshape(far.shape) > 0
    near = np.zeros(len(end), bool)
    for s in range(SEGMENTS):
        a, along = xy[row, s], (xy[:, s + 1] - xy[:, s])[row]  # [p, 2]
        share = ((end - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
        closest = a + np.clip(share, 0, 1)[:, None] * along
        whole = (ahead[:, s] & ahead[:, s + 1])[row]
        near |= whole & (((end - closest) ** 2).sum(-1) < TOLERANCE_PX**2)
    return near
