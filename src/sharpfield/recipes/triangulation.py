"""A sparse cloud of points from sharp pictures with known poses.

Details matched in several pictures form a *track*. Its point is where the rays of its
*sightings* pass closest to each other; sightings that do not agree are left out, and so are
points whose depth they leave open.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64

from sharpfield.recipes.matching import (
    PARALLAX_RAD,
    TOLERANCE_PX,
    choose_pairs,
    find_features,
    match,
)
from sharpfield.recipes.pictures import Pictures

LEAST_VIEWS = 3
"""That show a point, where there are so many: a wrong match of two pictures can agree by chance."""

ROUNDS_PX = (8.0, 3.0, TOLERANCE_PX)
"""Sightings farther than this from where their point projects are left out, round after round."""


@dataclass(frozen=True)
class Cloud:
    """Points, and the pictures that show them."""

    points: Float[np.ndarray, "m 3"]
    colours: Float[np.ndarray, "m c"]
    """Linear light: the mean of what the pictures show."""
    seen: Bool[np.ndarray, "n m"]
    """Which picture shows which point."""
    error_px: Float[np.ndarray, "m"]
    """Root mean square distance of the sightings from where the point projects."""

    def __getitem__(self, rows: Int64[np.ndarray, "k"] | Bool[np.ndarray, "m"]) -> "Cloud":
        """Some of the points."""
        return Cloud(self.points[rows], self.colours[rows], self.seen[:, rows], self.error_px[rows])


@dataclass(frozen=True)
class _Sightings:
    """Features that belong to tracks."""

    view: Int64[np.ndarray, "o"]
    track: Int64[np.ndarray, "o"]
    xy: Float[np.ndarray, "o 2"]
    direction: Float[np.ndarray, "o 3"]
    """In the world."""

    def __getitem__(self, kept: Bool[np.ndarray, "o"]) -> "_Sightings":
        return _Sightings(self.view[kept], self.track[kept], self.xy[kept], self.direction[kept])


def triangulate(pictures: Pictures) -> Cloud:
    """Points that several pictures show; none if the pictures have nothing in common."""
    seen, count = _tracks(pictures)
    points = np.zeros((count, 3))
    for limit in ROUNDS_PX:
        points = _closest(pictures, seen, points, count)
        seen = seen[_off_px(pictures, seen, points) < limit]
    points = _closest(pictures, seen, points, count)
    off = _off_px(pictures, seen, points)
    good = _parallax(pictures, seen, points) > PARALLAX_RAD
    shown = np.zeros((len(pictures), count), bool)
    shown[seen.view, seen.track] = True
    good &= (shown.sum(0) >= max(min(LEAST_VIEWS, len(pictures)), 2)) & (
        _largest(off, seen.track, count) < TOLERANCE_PX
    )
    sightings = np.maximum(np.bincount(seen.track, minlength=count), 1)
    error = np.sqrt(np.bincount(seen.track, off**2, minlength=count) / sightings)
    colours = np.zeros((count, pictures.light.shape[-1]))
    for view in range(len(pictures)):
        here = seen[seen.view == view]
        np.add.at(colours, here.track, pictures.look(here.xy, view))
    colours /= sightings[:, None]
    return Cloud(points, colours, shown, error)[good]


def _tracks(pictures: Pictures) -> tuple[_Sightings, int]:
    """Sightings of all matched features, and the number of tracks they form."""
    features = find_features(pictures)
    first = np.cumsum([0, *(len(found.xy) for found in features)])
    edges = [match(pictures, features, pair) + first[list(pair)] for pair in choose_pairs(pictures)]
    edge = np.concatenate([*edges, np.zeros((0, 2), np.int64)])
    label = _connected(edge, int(first[-1]))
    used = np.unique(edge)
    _, track = np.unique(label[used], return_inverse=True)
    view = np.searchsorted(first, used, side="right") - 1
    xy = np.concatenate([found.xy for found in features])[used]
    direction = np.zeros((len(used), 3))
    for v in range(len(pictures)):
        direction[view == v] = pictures.directions(xy[view == v], v)
    return _Sightings(view, track, xy, direction), int(track.max(initial=-1)) + 1


def _connected(edge: Int64[np.ndarray, "e 2"], count: int) -> Int64[np.ndarray, "n"]:
    """A label for each node, the same for all that edges connect."""
    label = np.arange(count)
    while True:
        least = label[edge].min(-1)
        before = label.copy()
        np.minimum.at(label, edge[:, 0], least)
        np.minimum.at(label, edge[:, 1], least)
        label = label[label]
        if (label == before).all():
            return label


def _closest(
    pictures: Pictures, seen: _Sightings, before: Float[np.ndarray, "m 3"], count: int
) -> Float[np.ndarray, "m 3"]:
    """Where rays pass closest to each other, distances counted as pixels from the second round on.

    The squared distance from a ray is a quadratic form; these add up over the rays of a track.
    """
    origin, ray = pictures.poses[seen.view, :, 3], seen.direction
    far = np.linalg.norm(before[seen.track] - origin, axis=-1)
    weight = 1 / np.maximum(far, 0.5 * pictures.near) ** 2 if before.any() else np.ones(len(ray))
    across = np.eye(3) - ray[:, :, None] * ray[:, None]  # what is seen of an offset
    across = across * weight[:, None, None]
    matrix, vector = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(matrix, seen.track, across)
    np.add.at(vector, seen.track, (across @ origin[..., None])[..., 0])
    size = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    # Parallel rays leave the depth open: the trace of a hair's breadth keeps it finite.
    matrix = matrix + (1e-12 * size + 1e-30) * np.eye(3)
    return np.linalg.solve(matrix, vector[..., None])[..., 0]


def _off_px(
    pictures: Pictures, seen: _Sightings, points: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "o"]:
    """Distance of sightings from where their points project; infinite behind the camera."""
    off = np.full(len(seen.view), np.inf)
    for view in range(len(pictures)):
        here = np.flatnonzero(seen.view == view)
        xy, depth = pictures.project(points[seen.track[here]], view)
        away = np.linalg.norm(xy - seen.xy[here], axis=-1)
        off[here] = np.where(depth > 0, away, np.inf)
    return off


def _parallax(
    pictures: Pictures, seen: _Sightings, points: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m"]:
    """Largest angle at each point between the first camera that sees it and the others."""
    toward = pictures.poses[seen.view, :, 3] - points[seen.track]
    toward = toward / np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-12)
    reference = np.zeros((len(points), 3))
    reference[seen.track[::-1]] = toward[::-1]  # the first one is written last
    angle = 2 * np.arcsin(
        np.clip(np.linalg.norm(toward - reference[seen.track], axis=-1) / 2, 0, 1)
    )
    return _largest(angle, seen.track, len(points))


def _largest(
    values: Float[np.ndarray, "o"], track: Int64[np.ndarray, "o"], count: int
) -> Float[np.ndarray, "m"]:
    found = np.zeros(count)
    np.maximum.at(found, track, values)
    return found
