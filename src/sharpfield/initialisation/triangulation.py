"""A sparse point cloud, triangulated from sharp images with known poses.

SIFT features are matched between pairs of images along *epipolar curves*: where a feature of one
image can be in another is known up to its depth. A lens bends the epipolar line, so it is followed
in straight segments; only features near it are compared, and so small and repeated details are
matched as well. Features matched in several images form a *track*; its point is where the rays of
its *observations* pass closest to each other. Observations that do not agree are left out, and so
are points without parallax.

Source: Hartley and Zisserman, *Multiple View Geometry* (2003), sections 9.1 and 12.2.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64

from sharpfield.core.tone import GAMMA
from sharpfield.geometry.two_views import (
    Features,
    mutual_matches,
    sift_features,
    squared_differences,
)
from sharpfield.initialisation.posed_images import Images

MAX_FEATURES = 4000
"""Of one image."""

MIN_CONTRAST = 0.01
"""Of a feature, a quarter of OpenCV's own: images are small and some noisy."""

NEIGHBOURS = 4
"""Other images each one is compared with."""

PARALLAX_RAD = np.deg2rad(1.0)
"""Least angle between two rays to a point; less leaves its depth undetermined."""

MIN_COSINE = 0.5
"""Least cosine between the optical axes of images that are compared."""

TOLERANCE_PX = 1.5
"""Distance of a feature from the epipolar curve."""

MAX_DIFFERENCE = 0.5
"""Squared difference of descriptors, 0...2, from which on features never match."""

SEGMENTS = 8
"""Straight pieces of an epipolar curve."""

MIN_VIEWS = 3
"""Images of a point, where there are so many: a wrong match of two images can agree by chance."""

ROUNDS_PX = (8.0, 3.0, TOLERANCE_PX)
"""Largest reprojection error of observations that are kept, round after round."""


def find_features(images: Images) -> list[Features]:
    """SIFT features of each image, as a display shows it: in linear light dark parts have none."""
    shown = (
        np.rint(255 * light.mean(-1) ** (1 / GAMMA)).astype(np.uint8) for light in images.light
    )
    return sift_features(shown, most=MAX_FEATURES, contrast=MIN_CONTRAST)


def choose_pairs(images: Images) -> list[tuple[int, int]]:
    """Pairs of images to compare: the nearest with enough parallax and similar optical axes."""
    centre, forward = images.poses[:, :, 3], images.poses[:, :, 2]
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    usual = 2 / (1 / images.near + 1 / images.far)
    usable = (apart > PARALLAX_RAD * usual) & (forward @ forward.T > MIN_COSINE)
    pairs = set[tuple[int, int]]()
    for i in range(len(images)):
        order = np.argsort(np.where(usable[i], apart[i], np.inf), kind="stable")[:NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order if usable[i, j]}
    return sorted(pairs)


def match(
    images: Images, features: list[Features], pair: tuple[int, int]
) -> Int64[np.ndarray, "m 2"]:
    """Rows of features of two images that match, each the best for the other."""
    a, b = (features[i] for i in pair)
    difference = squared_differences(a, b)
    row, column = np.nonzero(difference < MAX_DIFFERENCE)
    near = _near_epipolar(images, a.xy, b.xy[column], row, pair)
    possible = np.full(difference.shape, np.inf)
    possible[row[near], column[near]] = difference[row[near], column[near]]
    return mutual_matches(possible)


def _near_epipolar(
    images: Images,
    start: Float[np.ndarray, "m 2"],
    end: Float[np.ndarray, "p 2"],
    row: Int64[np.ndarray, "p"],
    pair: tuple[int, int],
) -> Bool[np.ndarray, "p"]:
    """Which positions in the second image lie near the epipolar curve of one in the first.

    Args:
        images: Both of them.
        start: Positions in the first image.
        end: Positions in the second.
        row: Whose curve (row of `start`) each of them is compared with.
        pair: The two images.
    """
    origin, direction = images.poses[pair[0], :, 3], images.directions(start, pair[0])
    depth = 1 / np.linspace(1.25 / images.near, 0.8 / images.far, SEGMENTS + 1)
    axis = images.poses[pair[0], :, 2]
    far = depth / np.maximum(direction @ axis, 1e-3)[:, None]  # [m, s], along the rays
    points = origin + far[..., None] * direction[:, None]
    xy, z = images.project(points.reshape(-1, 3), pair[1])
    xy, ahead = xy.reshape(*far.shape, 2), z.reshape(far.shape) > 0
    near = np.zeros(len(end), bool)
    for s in range(SEGMENTS):
        a, along = xy[row, s], (xy[:, s + 1] - xy[:, s])[row]  # [p, 2]
        share = ((end - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
        closest = a + np.clip(share, 0, 1)[:, None] * along
        whole = (ahead[:, s] & ahead[:, s + 1])[row]
        near |= whole & (((end - closest) ** 2).sum(-1) < TOLERANCE_PX**2)
    return near


@dataclass(frozen=True)
class Cloud:
    """Triangulated points, and the images that show them."""

    points: Float[np.ndarray, "m 3"]
    colours: Float[np.ndarray, "m c"]
    """Linear light: the mean of what the images show."""
    seen: Bool[np.ndarray, "n m"]
    """Which image shows which point."""
    error_px: Float[np.ndarray, "m"]
    """Root mean square distance of the observations from where the point projects."""

    def __getitem__(self, rows: Int64[np.ndarray, "k"] | Bool[np.ndarray, "m"]) -> "Cloud":
        """Some of the points."""
        return Cloud(self.points[rows], self.colours[rows], self.seen[:, rows], self.error_px[rows])


@dataclass(frozen=True)
class _Observations:
    """Features that belong to tracks."""

    view: Int64[np.ndarray, "o"]
    track: Int64[np.ndarray, "o"]
    xy: Float[np.ndarray, "o 2"]
    direction: Float[np.ndarray, "o 3"]
    """In the world."""

    def __getitem__(self, kept: Bool[np.ndarray, "o"]) -> "_Observations":
        return _Observations(self.view[kept], self.track[kept], self.xy[kept], self.direction[kept])


def triangulate(images: Images) -> Cloud:
    """Points that several images show; none if no features match."""
    seen, count = _tracks(images)
    points = np.zeros((count, 3))
    for limit in ROUNDS_PX:
        points = _triangulated(images, seen, points, count)
        seen = seen[_reprojection_px(images, seen, points) < limit]
    points = _triangulated(images, seen, points, count)
    off = _reprojection_px(images, seen, points)
    good = _parallax(images, seen, points) > PARALLAX_RAD
    shown = np.zeros((len(images), count), bool)
    shown[seen.view, seen.track] = True
    good &= (shown.sum(0) >= max(min(MIN_VIEWS, len(images)), 2)) & (
        _largest(off, seen.track, count) < TOLERANCE_PX
    )
    observations = np.maximum(np.bincount(seen.track, minlength=count), 1)
    error = np.sqrt(np.bincount(seen.track, off**2, minlength=count) / observations)
    colours = np.zeros((count, images.light.shape[-1]))
    for view in range(len(images)):
        here = seen[seen.view == view]
        np.add.at(colours, here.track, images.light_at(here.xy, view))
    colours /= observations[:, None]
    return Cloud(points, colours, shown, error)[good]


def _tracks(images: Images) -> tuple[_Observations, int]:
    """Observations of all matched features, and the number of tracks they form."""
    features = find_features(images)
    first = np.cumsum([0, *(len(found.xy) for found in features)])
    edges = [match(images, features, pair) + first[list(pair)] for pair in choose_pairs(images)]
    edge = np.concatenate([*edges, np.zeros((0, 2), np.int64)])
    label = _connected_components(edge, int(first[-1]))
    used = np.unique(edge)
    _, track = np.unique(label[used], return_inverse=True)
    view = np.searchsorted(first, used, side="right") - 1
    xy = np.concatenate([found.xy for found in features])[used]
    direction = np.zeros((len(used), 3))
    for v in range(len(images)):
        direction[view == v] = images.directions(xy[view == v], v)
    return _Observations(view, track, xy, direction), int(track.max(initial=-1)) + 1


def _connected_components(edge: Int64[np.ndarray, "e 2"], count: int) -> Int64[np.ndarray, "n"]:
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


def _triangulated(
    images: Images, seen: _Observations, before: Float[np.ndarray, "m 3"], count: int
) -> Float[np.ndarray, "m 3"]:
    """Points where the rays of each track pass closest to each other, in the least-squares sense.

    From the second round on, distances are weighted by depth, so that they count as pixels.

    The squared distance from a ray is a quadratic form; these add up over the rays of a track.
    """
    origin, ray = images.poses[seen.view, :, 3], seen.direction
    far = np.linalg.norm(before[seen.track] - origin, axis=-1)
    weight = 1 / np.maximum(far, 0.5 * images.near) ** 2 if before.any() else np.ones(len(ray))
    across = np.eye(3) - ray[:, :, None] * ray[:, None]  # removes what is along the ray
    across = across * weight[:, None, None]
    matrix, vector = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(matrix, seen.track, across)
    np.add.at(vector, seen.track, (across @ origin[..., None])[..., 0])
    size = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    # Parallel rays leave the depth undetermined: a tiny multiple of the trace keeps it finite.
    matrix = matrix + (1e-12 * size + 1e-30) * np.eye(3)
    return np.linalg.solve(matrix, vector[..., None])[..., 0]


def _reprojection_px(
    images: Images, seen: _Observations, points: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "o"]:
    """Reprojection error of observations; infinite behind the camera."""
    off = np.full(len(seen.view), np.inf)
    for view in range(len(images)):
        here = np.flatnonzero(seen.view == view)
        xy, depth = images.project(points[seen.track[here]], view)
        away = np.linalg.norm(xy - seen.xy[here], axis=-1)
        off[here] = np.where(depth > 0, away, np.inf)
    return off


def _parallax(
    images: Images, seen: _Observations, points: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m"]:
    """Largest angle at each point between the first camera that sees it and the others."""
    toward = images.poses[seen.view, :, 3] - points[seen.track]
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
