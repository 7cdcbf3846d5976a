"""The same detail found in two images whose poses are known.

A *feature* is a position with a description of its surroundings. Where a feature of one image
can be in another is known up to its depth: on a piece of a curve, the *trace* of its ray. Only
features near the trace are compared, so that small and repeated details are matched as well.

Source: Lowe, "Distinctive image features from scale-invariant keypoints" (IJCV 2004) for features
and the ratio of the best to the second best.

A sparse cloud of points from sharp images with known poses.

Details matched in several images form a *track*. Its point is where the rays of its
*sightings* pass closest to each other; sightings that do not agree are left out, and so are
points whose depth they leave open.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from sharpfield.core.tone import GAMMA
from sharpfield.initialisation.posed_images import Images

MOST_FEATURES = 4000
"""Of one image."""

FAINTEST = 0.01
"""Contrast of a feature, about a third of the customary one: images are small and some noisy."""

NEIGHBOURS = 4
"""Other images each one is compared with."""

PARALLAX_RAD = np.deg2rad(1.0)
"""Least angle between two rays to a point; less leaves its depth open."""

TOWARD = 0.5
"""Least cosine between the axes of images that are compared."""

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
    """Of one image."""

    xy: Float[np.ndarray, "m 2"]
    """In pixels, the centre of the first one at 0.5."""
    about: Float32[np.ndarray, "m 128"]
    """Descriptions of unit length."""


def find_features(images: Images) -> list[Features]:
    """Features of each image, as a display shows it: light alone hides the dark parts."""
    sift = cv2.SIFT_create(  # pyright: ignore
        MOST_FEATURES, contrastThreshold=FAINTEST, enable_precise_upscale=True
    )
    found = []
    for light in images.light:
        shown = np.rint(255 * light.mean(-1) ** (1 / GAMMA)).astype(np.uint8)
        points, about = sift.detectAndCompute(shown, None)
        xy = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
        about = np.zeros((0, 128), np.float32) if about is None else about
        _, first = np.unique(xy, axis=0, return_index=True)  # one per place, not per orientation
        length = np.linalg.norm(about, axis=-1, keepdims=True)
        found.append(Features(xy[first], (about / np.maximum(length, 1e-9))[first]))
    return found


def choose_pairs(images: Images) -> list[tuple[int, int]]:
    """Images to compare: the nearest ones with enough parallax that look the same way."""
    centre, forward = images.poses[:, :, 3], images.poses[:, :, 2]
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    usual = 2 / (1 / images.near + 1 / images.far)
    usable = (apart > PARALLAX_RAD * usual) & (forward @ forward.T > TOWARD)
    pairs = set[tuple[int, int]]()
    for i in range(len(images)):
        order = np.argsort(np.where(usable[i], apart[i], np.inf), kind="stable")[:NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order if usable[i, j]}
    return sorted(pairs)


def match(
    images: Images, features: list[Features], pair: tuple[int, int]
) -> Int64[np.ndarray, "m 2"]:
    """Rows of features in two images that show the same detail: each the best for the other."""
    first, second = pair
    a, b = features[first], features[second]
    if not len(a.xy) or not len(b.xy):
        return np.zeros((0, 2), np.int64)
    unlike = 2 - 2 * np.minimum(a.about @ b.about.T, 1)  # squared difference
    row, column = np.nonzero(unlike < UNLIKE)
    near = _near_trace(images, a.xy, b.xy[column], row, pair)
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
    images: Images,
    start: Float[np.ndarray, "m 2"],
    end: Float[np.ndarray, "p 2"],
    row: Int64[np.ndarray, "p"],
    pair: tuple[int, int],
) -> Bool[np.ndarray, "p"]:
    """Which positions in the second image lie near the trace of a ray of the first.

    Args:
        images: Both of them.
        start: Positions in the first image.
        end: Positions in the second.
        row: Whose ray (row of `start`) each of them is compared with.
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


LEAST_VIEWS = 3
"""That show a point, where there are so many: a wrong match of two images can agree by chance."""

ROUNDS_PX = (8.0, 3.0, TOLERANCE_PX)
"""Sightings farther than this from where their point projects are left out, round after round."""


@dataclass(frozen=True)
class Cloud:
    """Points, and the images that show them."""

    points: Float[np.ndarray, "m 3"]
    colours: Float[np.ndarray, "m c"]
    """Linear light: the mean of what the images show."""
    seen: Bool[np.ndarray, "n m"]
    """Which image shows which point."""
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


def triangulate(images: Images) -> Cloud:
    """Points that several images show; none if the images have nothing in common."""
    seen, count = _tracks(images)
    points = np.zeros((count, 3))
    for limit in ROUNDS_PX:
        points = _closest(images, seen, points, count)
        seen = seen[_off_px(images, seen, points) < limit]
    points = _closest(images, seen, points, count)
    off = _off_px(images, seen, points)
    good = _parallax(images, seen, points) > PARALLAX_RAD
    shown = np.zeros((len(images), count), bool)
    shown[seen.view, seen.track] = True
    good &= (shown.sum(0) >= max(min(LEAST_VIEWS, len(images)), 2)) & (
        _largest(off, seen.track, count) < TOLERANCE_PX
    )
    sightings = np.maximum(np.bincount(seen.track, minlength=count), 1)
    error = np.sqrt(np.bincount(seen.track, off**2, minlength=count) / sightings)
    colours = np.zeros((count, images.light.shape[-1]))
    for view in range(len(images)):
        here = seen[seen.view == view]
        np.add.at(colours, here.track, images.look(here.xy, view))
    colours /= sightings[:, None]
    return Cloud(points, colours, shown, error)[good]


def _tracks(images: Images) -> tuple[_Sightings, int]:
    """Sightings of all matched features, and the number of tracks they form."""
    features = find_features(images)
    first = np.cumsum([0, *(len(found.xy) for found in features)])
    edges = [match(images, features, pair) + first[list(pair)] for pair in choose_pairs(images)]
    edge = np.concatenate([*edges, np.zeros((0, 2), np.int64)])
    label = _connected(edge, int(first[-1]))
    used = np.unique(edge)
    _, track = np.unique(label[used], return_inverse=True)
    view = np.searchsorted(first, used, side="right") - 1
    xy = np.concatenate([found.xy for found in features])[used]
    direction = np.zeros((len(used), 3))
    for v in range(len(images)):
        direction[view == v] = images.directions(xy[view == v], v)
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
    images: Images, seen: _Sightings, before: Float[np.ndarray, "m 3"], count: int
) -> Float[np.ndarray, "m 3"]:
    """Where rays pass closest to each other, distances counted as pixels from the second round on.

    The squared distance from a ray is a quadratic form; these add up over the rays of a track.
    """
    origin, ray = images.poses[seen.view, :, 3], seen.direction
    far = np.linalg.norm(before[seen.track] - origin, axis=-1)
    weight = 1 / np.maximum(far, 0.5 * images.near) ** 2 if before.any() else np.ones(len(ray))
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
    images: Images, seen: _Sightings, points: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "o"]:
    """Distance of sightings from where their points project; infinite behind the camera."""
    off = np.full(len(seen.view), np.inf)
    for view in range(len(images)):
        here = np.flatnonzero(seen.view == view)
        xy, depth = images.project(points[seen.track[here]], view)
        away = np.linalg.norm(xy - seen.xy[here], axis=-1)
        off[here] = np.where(depth > 0, away, np.inf)
    return off


def _parallax(
    images: Images, seen: _Sightings, points: Float[np.ndarray, "m 3"]
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
