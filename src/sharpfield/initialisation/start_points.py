"""Points to start Gaussians from, near the surfaces that images with known poses show.

A sparse point *cloud* comes with the capture or is triangulated from the images. Up to the number
of points asked for, random pixels of the images are added, at the depth of the cloud around them;
a few of them, or all where there is no cloud, at a random depth between near and far.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Generator

from sharpfield.initialisation.posed_images import Images
from sharpfield.initialisation.triangulation import Cloud, triangulate

RANDOM_DEPTH = 0.05
"""Fraction of random pixels whose depth is random even where there is a cloud."""

NEIGHBOURS = 4
"""Points of the cloud, as seen in the image, whose median gives the depth of a pixel."""

SPREAD = 0.02
"""Least relative spread of the inverse depth; that of the neighbours is added."""


@dataclass(frozen=True)
class StartPoints:
    """Points to start from."""

    points: Float32[np.ndarray, "n 3"]
    colours: Float32[np.ndarray, "n c"]
    """Linear light."""
    sizes: Float32[np.ndarray, "n"]
    """In world units, so that all together fill an image."""


def starting_points(
    images: Images,
    count: int,
    generator: Generator,
    *,
    known: Float[np.ndarray, "m 3"] | None = None,
    size: float = 0.7,
) -> StartPoints:
    """Points near the surfaces of a scene.

    Args:
        images: Sharp ones, at least one.
        count: How many points.
        generator: On the CPU; chooses random pixels.
        known: A sparse cloud, where there is one.
        size: Of each point, relative to the distance of its neighbours in an image.
    """
    cloud = triangulate(images) if known is None else _visible_points(images, known)
    if len(cloud.points) > count:
        chosen = torch.randperm(len(cloud.points), generator=generator)[:count].numpy()
        cloud = cloud[chosen]
    drawn, colours, depth = _random_pixels(images, cloud, count - len(cloud.points), generator)
    points = np.concatenate([cloud.points, drawn])
    nearest = np.full(len(cloud.points), np.inf)
    shown = 0
    for view in range(len(images)):
        xy, away = images.project(points, view)
        shown += int((images.inside(xy) & (away > 0)).sum())
        seen = cloud.seen[view]
        nearest[seen] = np.minimum(nearest, away[: len(nearest)])[seen]
    camera = images.camera
    apart_px = np.sqrt(camera.width * camera.height * len(images) / max(shown, 1))
    sizes = size * apart_px * np.concatenate([nearest, depth]) / camera.fx_px
    return StartPoints(
        points.astype(np.float32),
        np.concatenate([cloud.colours, colours]).astype(np.float32),
        sizes.astype(np.float32),
    )


def _visible_points(images: Images, points: Float[np.ndarray, "m 3"]) -> Cloud:
    """Known points that project into some image; occlusion is not known."""
    seen = np.zeros((len(images), len(points)), bool)
    shown = np.full((*seen.shape, images.light.shape[-1]), np.nan)
    for view in range(len(images)):
        xy, depth = images.project(points, view)
        seen[view] = images.inside(xy) & (depth > 0)
        shown[view, seen[view]] = images.light_at(xy[seen[view]], view)
    some = seen.any(0)
    colours = np.nanmedian(shown[:, some], 0)  # in most images nothing occludes a point
    return Cloud(points[some], colours, seen[:, some], np.zeros(int(some.sum())))


def _random_pixels(
    images: Images, cloud: Cloud, count: int, generator: Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n c"], Float[np.ndarray, "n"]]:
    """Random pixels, as points with their colour and depth."""
    chance = torch.rand(count, 5, generator=generator, dtype=torch.float64).numpy()
    normal = torch.randn(count, generator=generator, dtype=torch.float64).numpy()
    views = (chance[:, 0] * len(images)).astype(np.int64)
    xy = chance[:, 1:3] * images.camera.size
    nearest, farthest = 1 / images.near, 1 / images.far
    inverse = farthest + (nearest - farthest) * chance[:, 3]
    points = np.zeros((count, 3))
    colours = np.zeros((count, images.light.shape[-1]))
    for view in range(len(images)):
        here = np.flatnonzero(views == view)
        colours[here] = images.light_at(xy[here], view)
        near_cloud = here[chance[here, 4] >= RANDOM_DEPTH]
        found = _cloud_depth(images, cloud, view, xy[near_cloud])
        if found is not None:
            middle, spread = found
            guess = middle + (spread + SPREAD * middle) * normal[near_cloud]
            inverse[near_cloud] = np.clip(guess, farthest, nearest)
        pose = images.poses[view]
        ray = images.directions(xy[here], view)
        along = 1 / (inverse[here] * np.maximum(ray @ pose[:, 2], 1e-3))
        points[here] = pose[:, 3] + along[:, None] * ray
    return points, colours, 1 / inverse


def _cloud_depth(
    images: Images, cloud: Cloud, view: int, xy: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]] | None:
    """Inverse depth of the cloud at pixels of an image, and its spread; None without neighbours.

    Occluded points have the wrong depth; only if an image shows too few for sure, all points that
    project into it are used.
    """
    where, depth = images.project(cloud.points, view)
    usable = images.inside(where) & (depth > 0)
    sure = np.flatnonzero(usable & cloud.seen[view])
    rows = sure if len(sure) >= NEIGHBOURS else np.flatnonzero(usable)
    if len(rows) < NEIGHBOURS:
        return None
    inverse = 1 / depth[rows][_nearest(xy, where[rows])]  # [m, NEIGHBOURS]
    middle = np.median(inverse, -1)
    return middle, np.median(np.abs(inverse - middle[:, None]), -1)


def _nearest(
    xy: Float[np.ndarray, "m 2"], others: Float[np.ndarray, "k 2"]
) -> Int64[np.ndarray, "m 4"]:
    """Rows of the nearest positions."""
    away = ((xy[:, None] - others) ** 2).sum(-1)
    return np.argpartition(away, NEIGHBOURS - 1, axis=-1)[:, :NEIGHBOURS]
