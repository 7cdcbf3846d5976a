"""Where moving Gaussians start: they fill the visual hull of what moves, at all times."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone
from sharpfield.events.index import EventIndex
from sharpfield.fields.gaussians.dynamic import MovingGaussians
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.initialisation.static_points import GREY
from sharpfield.initialisation.visual_hull import SPACING, box_cells, moving_cells

FILL = 0.5
"""First scale of moving Gaussians, relative to the distance at which they fill the hull."""


def moving_gaussians(
    capture: Capture,
    index: EventIndex | None,
    tone: Tone,
    count: int,
    seed: int,
    *,
    lifespan: float,
    opacity: float,
) -> MovingGaussians:
    """Gaussians that fill the hull of every lifespan, coloured as the frames around it show them.

    Args:
        capture: In a world whose box from -1 to 1 holds what moves.
        index: Of its events, if it has any.
        tone: Gaussians hold stored values.
        count: How many.
        seed: Of the run.
        lifespan: Of each Gaussian, as a fraction of the capture.
        opacity: Of each.
    """
    made = generator(seed, 0, "moving")
    times = (np.arange(windows := max(round(1 / lifespan), 1)) + 0.5) / windows
    parts = []
    for i, time in enumerate(times.tolist()):
        own = count * (i + 1) // windows - count * i // windows
        cells = moving_cells(capture, index, (time - 0.5 / windows, time + 0.5 / windows))
        cells = box_cells() if cells is None else cells
        drawn = torch.randint(len(cells), (own,), generator=made)
        points = cells[drawn] + SPACING * (torch.rand(own, 3, generator=made) - 0.5)
        size = FILL * (len(cells) * SPACING**3 / max(own, 1)) ** (1 / 3)
        colours = _colours(capture, points, time)
        if colours is None:
            channels = 3 if capture.needed_events.coloured else 1
            colours = tone.encode(torch.full((own, channels), GREY))
        centre_times = time + (torch.rand(own, generator=made) - 0.5) / windows
        parts.append((points, colours, torch.full((own,), size), centre_times))
    points, colours, sizes, centre_times = (torch.cat(part) for part in zip(*parts, strict=True))
    base = Gaussians.start(points, colours, sizes, opacity=opacity)
    return MovingGaussians(base, centre_times, lifespan=lifespan)


def _colours(
    capture: Capture, points: Float[Tensor, "n 3"], time: float
) -> Float[Tensor, "n c"] | None:
    """Mean stored value, over the cameras, at the pixels of points; None without frames."""
    if capture.frames is None:
        return None
    frames, train = capture.frames, capture.split.train
    at = int(capture.clock.us(time))
    total = torch.zeros(len(points), frames.channels)
    count = torch.zeros(len(points))
    for track in np.unique(frames.track[train]):
        own = train[frames.track[train] == track]
        frame = int(own[np.abs(frames.exposure.middle_us[own] - at).argmin()])
        pose = capture.frame_pose(np.array([frame]))[0].detach().float()
        local = (points - pose[:, 3]) @ pose[:, :3]
        column, row = capture.camera.project(local).nan_to_num(-1.0).floor().long().unbind(-1)
        inside = (local[:, 2] > 0) & (column >= 0) & (column < capture.camera.width)
        inside &= (row >= 0) & (row < capture.camera.height)
        image = torch.from_numpy(frames.images[frame].astype(np.float32)) / frames.white
        total[inside] += image[row[inside], column[inside]]
        count += inside
    return total / count.clamp_min(1)[:, None]
