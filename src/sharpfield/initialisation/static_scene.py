"""Where static Gaussians start, from whatever a capture has.

Depth that a camera measured gives points on surfaces. Otherwise points are triangulated from sharp
images, or placed around a known sparse cloud: of a static scene the images are the frames,
deblurred with events; of a moving one they are the *backdrop*, what each camera sees most of the
time. Without frames, points fill what the cameras see, in grey.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Generator

from sharpfield.core.capture import Capture
from sharpfield.core.tone import Tone, tone_of
from sharpfield.events.threshold import FixedThresholds
from sharpfield.geometry.trajectory import count_tracks
from sharpfield.initialisation.posed_images import Images, sharp_images
from sharpfield.initialisation.start_points import StartPoints, starting_points
from sharpfield.sampling.view_measurements import MeasuredDepth

MAX_FRAMES = 48
"""Frames whose pixels become points; neighbours in a walk see the same."""


def points_on_surfaces(
    capture: Capture,
    tone: Tone,
    count: int,
    generator: Generator,
    *,
    weights: Float[np.ndarray, "n"] | None = None,
    size: float = 0.7,
) -> StartPoints:
    """Points at measured depth, with the colours of the frames' pixels.

    Args:
        capture: With frames and depth.
        tone: Of the frames.
        count: How many points, if enough depth is known.
        generator: On the CPU; chooses the pixels.
        weights: Of each training frame, for its quality; the best of neighbouring frames is used.
        size: Of each point, relative to the distance between neighbours if all of them covered
            the surfaces evenly.
    """
    depth = MeasuredDepth(capture.needed_depth, capture.camera)
    chosen = _best_frames(capture.split.train, weights)
    frames, camera = capture.needed_frames, capture.camera
    ray = camera.direction(camera.grid().double()).numpy()
    ray = ray / ray[..., 2:]
    poses = capture.frame_pose(chosen).detach().double().numpy()
    each = -(-count // len(chosen))
    points, colours, depths = [], [], []
    for frame, pose in zip(chosen, poses, strict=True):
        seen = depth.at(int(frame))
        row, column = np.nonzero(seen)
        if not len(row):
            continue
        take = torch.randint(len(row), (each,), generator=generator).numpy()
        row, column = row[take], column[take]
        far = seen[row, column].astype(np.float64)
        points.append(far[:, None] * ray[row, column] @ pose[:, :3].T + pose[:, 3])
        stored = torch.from_numpy(frames.images[frame][row, column].astype(np.float32))
        colours.append(tone.decode(stored / frames.white).numpy())
        depths.append(far)
    xyz, far = np.concatenate(points)[:count], np.concatenate(depths)[:count]
    spacing = _spacing(xyz)
    return StartPoints(
        xyz.astype(np.float32),
        np.concatenate(colours)[:count].astype(np.float32),
        (size * np.minimum(spacing, 0.1 * far)).astype(np.float32),
    )


def _best_frames(
    train: Int64[np.ndarray, "t"], weights: Float[np.ndarray, "t"] | None
) -> Int64[np.ndarray, "m"]:
    """At most `MAX_FRAMES` frames, spread over the capture, the best of their neighbours."""
    groups = np.array_split(np.arange(len(train)), min(MAX_FRAMES, len(train)))
    if weights is None:
        return train[[group[len(group) // 2] for group in groups]]
    return train[[group[np.argmax(weights[group])] for group in groups]]


def _spacing(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Approximate distance between neighbours at each point, from counts in cubes."""
    edge = np.ptp(points, axis=0).max() / 64 + 1e-9
    cube = np.floor(points / edge).astype(np.int64)
    _, which, counts = np.unique(cube, axis=0, return_inverse=True, return_counts=True)
    # A surface crosses a cube in about its edge squared.
    return edge / np.sqrt(counts[which.reshape(-1)])


GREY = 0.2
"""Linear light that a scene without frames starts from."""

PATH_VIEWS = 16
"""Camera positions along a trajectory from which a scene without frames is filled."""

MAX_VIEWS = 32
"""Frames of one moving camera that the backdrop is made of."""


def static_points(
    capture: Capture,
    tone: Tone,
    thresholds: tuple[float, float],
    count: int,
    generator: Generator,
    *,
    weights: Float[np.ndarray, "n"] | None = None,
    size: float = 0.7,
) -> StartPoints:
    """Points near the surfaces of a static scene.

    Args:
        capture: In the model's space.
        tone: Of the frames.
        thresholds: Contrast thresholds to darker and to brighter.
        count: How many points.
        generator: On the CPU.
        weights: Of each training frame, for its quality.
        size: Of each point, relative to the distance of its neighbours in an image.
    """
    if capture.frames is None:
        known = np.zeros((0, 3)) if capture.points is None else capture.points
        return starting_points(grey_images(capture), count, generator, known=known, size=size)
    if capture.depth is not None:
        return points_on_surfaces(capture, tone, count, generator, weights=weights, size=size)
    images = sharp_images(capture, FixedThresholds(*thresholds))
    return starting_points(images, count, generator, known=capture.points, size=size)


def backdrop_points(
    capture: Capture, count: int, generator: Generator, *, size: float = 0.7
) -> StartPoints:
    """Points near what does not move in a scene, see `static_points` and `backdrop`."""
    known = np.zeros((0, 3)) if capture.frames is None else capture.points
    return starting_points(backdrop(capture), count, generator, known=known, size=size)


def backdrop(capture: Capture) -> Images:
    """What does not move: the median of each static camera's frames, and frames of moving ones."""
    if capture.frames is None:
        return grey_images(capture)
    frames, train = capture.frames, capture.split.train
    stored, chosen = [], []
    for track in np.unique(frames.track[train]):
        own = train[frames.track[train] == track]
        if capture.trajectory.known_us(int(track)) is None:
            stored.append(np.median(frames.images[own], 0))
            chosen.append(own[len(own) // 2])
        else:
            some = own[:: -(-len(own) // MAX_VIEWS)]
            stored.extend(frames.images[some].astype(np.float64))
            chosen.extend(some)
    values = torch.from_numpy(np.stack(stored)).float() / frames.white
    poses = capture.frame_pose(np.array(chosen)).detach().double().numpy()
    light = tone_of(frames.encoding).decode(values).numpy()
    return Images(capture.camera, light, poses, capture.near, capture.far)


def background_colour(capture: Capture, tone: Tone) -> Float[torch.Tensor, "c"]:
    """The median stored value of the backdrop: a first guess of what is behind everything."""
    light = backdrop(capture).light
    return tone.encode(torch.from_numpy(np.median(light.reshape(-1, light.shape[-1]), 0)))


def grey_images(capture: Capture) -> Images:
    """Grey images along the trajectory of the first camera, or of all cameras that do not move."""
    camera, path = capture.camera, capture.trajectory
    if path.known_us(0) is not None or count_tracks(path) == 1:
        time, track = torch.linspace(0, 1, PATH_VIEWS), torch.zeros(PATH_VIEWS, dtype=torch.int64)
    else:
        track = torch.arange(count_tracks(path))
        time = torch.full((len(track),), 0.5)
    poses = path.pose(time, track).detach().double().numpy()
    channels = 3 if capture.needed_events.coloured else 1
    light = np.full((len(time), camera.height, camera.width, channels), GREY, np.float32)
    return Images(camera, light, poses, capture.near, capture.far)
