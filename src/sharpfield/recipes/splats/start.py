"""The Gaussians that a splat recipe starts from."""

import numpy as np
import torch
from jaxtyping import Float

from sharpfield.core.capture import Capture
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone
from sharpfield.events.threshold import FixedThresholds
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.initialisation.from_depth import points_on_surfaces
from sharpfield.initialisation.posed_images import Images, sharp_images
from sharpfield.initialisation.start_points import starting_points
from sharpfield.recipes.splats.scene import GaussianOptions, budget_of

GREY = 0.2
"""Linear light that a scene without frames starts from."""

PATH_VIEWS = 16
"""Places along the trajectory from which a scene without frames is filled."""


def starting_gaussians(
    options: GaussianOptions,
    capture: Capture,
    thresholds: tuple[float, float],
    tone: Tone,
    seed: int,
    *,
    weights: Float[np.ndarray, "n"] | None = None,
) -> Gaussians:
    """Small round Gaussians near the surfaces, as well as can be told.

    Args:
        options: How many and how large.
        capture: In its normalised space.
        thresholds: Of the events, to darker and to brighter.
        tone: Gaussians hold stored values.
        seed: Of the run.
        weights: Of the frames to learn from, for their quality.
    """
    made = generator(seed, 0, "start")
    count = max(int(options.start * budget_of(options, capture)), 1)
    if capture.frames is not None and capture.depth is not None:
        start = points_on_surfaces(capture, tone, count, made, weights=weights, size=options.size)
    else:
        images = (
            _grey(capture)
            if capture.frames is None
            else sharp_images(capture, FixedThresholds(*thresholds))
        )
        known = _known(capture)
        start = starting_points(images, count, made, known=known, size=options.size)
    return Gaussians.start(
        torch.from_numpy(start.points),
        tone.encode(torch.from_numpy(start.colours)),
        torch.from_numpy(start.sizes),
        degree=options.degree,
        opacity=options.opacity,
    )


def _known(capture: Capture) -> np.ndarray | None:
    points = capture.points
    if capture.frames is None:
        return np.zeros((0, 3)) if points is None else points
    return points


def _grey(capture: Capture) -> Images:
    """What a scene looks like that only events have seen."""
    width, height = capture.camera.size
    time = torch.linspace(0, 1, PATH_VIEWS)
    poses = capture.trajectory.pose(time, torch.zeros(PATH_VIEWS, dtype=torch.int64))
    channels = 3 if capture.needed_events.coloured else 1
    light = np.full((PATH_VIEWS, height, width, channels), GREY, np.float32)
    return Images(capture.camera, light, poses.detach().double().numpy(), capture.near, capture.far)
