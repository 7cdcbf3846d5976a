"""Where the Gaussians of a moving scene start: what stands still, and what moves.

Cameras that stand still see the *backdrop*: what they see most of the time, at each pixel. From
these images the still Gaussians start. The moving ones fill the *hull* of each moment: places
that nearly all of these cameras see in *busy* pixels, where there are events, or where a frame
differs from the backdrop
(compare `initialisation/visual_hull.py`, which asks the same of the whole recording).

Source: visual hulls, Laurentini (PAMI 1994).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sharpfield.core.capture import Capture
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone, tone_of
from sharpfield.events.image import window_image
from sharpfield.events.index import EventIndex
from sharpfield.fields.gaussians.dynamic import MovingGaussians
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry.trajectory import count_tracks
from sharpfield.initialisation.posed_images import Images
from sharpfield.initialisation.start_points import starting_points

GREY = 0.2
"""Linear light that a scene without frames starts from."""

CELLS = 48
"""Of the hull, along each axis of the box."""
SPACING = 2 / CELLS

FILL = 0.5
"""First size of moving Gaussians, relative to the distance at which they fill the hull."""

CHANGED = 0.08
"""Difference of stored values between two frames that makes a pixel busy."""

AGREED = 0.8
"""Part of the cameras that see a place, which must see it busy."""

MOST_VIEWS = 32
"""Frames of moving cameras that show what stands still."""


@dataclass(frozen=True)
class Hull:
    """Where something moves in a window of time."""

    cells: Float[Tensor, "a 3"]
    """Centres of all cells of the box."""
    kept: Bool[Tensor, "a"]
    """In which of them something moves."""

    @property
    def places(self) -> Float[Tensor, "n 3"]:
        """Centres of the cells in which something moves."""
        return self.cells[self.kept]


def still_start(
    capture: Capture, tone: Tone, count: int, seed: int, *, degree: int, size: float, opacity: float
) -> Gaussians:
    """Gaussians near what stands still, as well as the backdrop tells.

    Args:
        capture: In the model's space.
        tone: Gaussians hold stored values.
        count: How many.
        seed: Of the run.
        degree: Of their harmonics.
        size: See `starting_points`.
        opacity: Of each.
    """
    made = generator(seed, 0, "still")
    images = backdrop(capture)
    known = np.zeros((0, 3)) if capture.frames is None else capture.points
    start = starting_points(images, count, made, known=known, size=size)
    return Gaussians.start(
        torch.from_numpy(start.points),
        tone.encode(torch.from_numpy(start.colours)),
        torch.from_numpy(start.sizes),
        degree=degree,
        opacity=opacity,
    )


def backdrop(capture: Capture) -> Images:
    """What stands still: the median of each still camera's frames, and frames of moving ones."""
    camera, path = capture.camera, capture.trajectory
    if capture.frames is None:
        track = torch.arange(count_tracks(path))
        poses = path.pose(torch.full((len(track),), 0.5), track).detach().double().numpy()
        light = np.full((len(track), camera.height, camera.width, 1), GREY, np.float32)
        return Images(camera, light, poses, capture.near, capture.far)
    frames, train = capture.frames, capture.split.train
    stored, chosen = [], []
    for track in np.unique(frames.track[train]):
        own = train[frames.track[train] == track]
        if path.known_us(int(track)) is None:
            stored.append(np.median(frames.images[own], 0))
            chosen.append(own[len(own) // 2])
        else:
            some = own[:: -(-len(own) // MOST_VIEWS)]
            stored.extend(frames.images[some].astype(np.float64))
            chosen.extend(some)
    values = torch.from_numpy(np.stack(stored)).float() / frames.white
    poses = capture.frame_pose(np.array(chosen)).detach().double().numpy()
    light = tone_of(frames.encoding).decode(values).numpy()
    return Images(camera, light, poses, capture.near, capture.far)


def usual_colour(capture: Capture, tone: Tone) -> Float[Tensor, "c"]:
    """What most pixels of the backdrop store: a first guess of what is behind everything."""
    light = backdrop(capture).light
    return tone.encode(torch.from_numpy(np.median(light.reshape(-1, light.shape[-1]), 0)))


def moving_start(
    capture: Capture,
    index: EventIndex | None,
    tone: Tone,
    count: int,
    seed: int,
    *,
    span: float,
    opacity: float,
) -> MovingGaussians:
    """Gaussians that fill the hull of every moment, coloured as the frames around it show them.

    Args:
        capture: In the model's space.
        index: Of its events, if it has any.
        tone: Gaussians hold stored values.
        count: How many.
        seed: Of the run.
        span: Of each Gaussian, as a part of the capture.
        opacity: Of each.
    """
    made = generator(seed, 0, "moving")
    times = (np.arange(moments := max(round(1 / span), 1)) + 0.5) / moments
    parts = []
    for place, time in enumerate(times.tolist()):
        own = count * (place + 1) // moments - count * place // moments
        hull = hull_between(capture, index, (time - 0.5 / moments, time + 0.5 / moments))
        cells = (box() if hull is None else hull).places
        drawn = torch.randint(len(cells), (own,), generator=made)
        points = cells[drawn] + SPACING * (torch.rand(own, 3, generator=made) - 0.5)
        size = FILL * (len(cells) * SPACING**3 / max(own, 1)) ** (1 / 3)
        colours = _colours(capture, points, time)
        if colours is None:
            colours = tone.encode(torch.full((own, 1), GREY))
        when = time + (torch.rand(own, generator=made) - 0.5) / moments
        parts.append((points, colours, torch.full((own,), size), when))
    points, colours, sizes, when = (torch.cat(part) for part in zip(*parts, strict=True))
    base = Gaussians.start(points, colours, sizes, opacity=opacity)
    return MovingGaussians(base, when, span=span)


def box() -> Hull:
    """All of the box."""
    along = (torch.arange(CELLS) + 0.5) * SPACING - 1
    cells = torch.stack(torch.meshgrid(along, along, along, indexing="ij"), -1).view(-1, 3)
    return Hull(cells, torch.ones(len(cells), dtype=torch.bool))


def hull_between(
    capture: Capture, index: EventIndex | None, window: tuple[float, float]
) -> Hull | None:
    """Where something moves in a window of time; None if no camera that stands still can tell.

    Args:
        capture: In a world whose box from -1 to 1 holds what moves.
        index: Of its events, if it has any.
        window: 0...1.
    """
    places = box().cells
    seen, agreed = torch.zeros(len(places)), torch.zeros(len(places))
    for track in range(count_tracks(capture.trajectory)):
        busy = busy_pixels(capture, index, track, window)
        if busy is None:
            continue
        inside, active = _looked_up(capture, busy, track, places)
        seen += inside
        agreed += inside & active
    kept = (seen > 0) & (agreed >= AGREED * seen) & (seen >= seen.max() / 2)
    return Hull(places, kept) if kept.any() else None


def busy_pixels(
    capture: Capture, index: EventIndex | None, track: int, window: tuple[float, float]
) -> Bool[Tensor, "h w"] | None:
    """Where a still camera sees something move; None if it moves itself, or cannot tell."""
    if capture.trajectory.known_us(track) is not None:
        return None
    camera = capture.camera
    start, end = (int(capture.clock.us(time)) for time in window)
    busy = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    if index is not None and track < index.tracks:
        size = {"width": camera.width, "height": camera.height}
        busy |= torch.from_numpy(window_image(index, start, end, track=track, **size).sum(-1) > 0)
    if capture.frames is not None:
        frames, train = capture.frames, capture.split.train
        own = train[frames.track[train] == track]
        middle = frames.exposure.middle_us[own]
        among = own[(middle >= start) & (middle <= end)]
        if len(among) and len(own) > 2:
            images = frames.images[among].astype(np.float32)
            backdrop = np.median(frames.images[own], 0)
            differs = np.abs(images - backdrop).max(-1).max(0) > CHANGED * frames.white
            busy |= torch.from_numpy(differs)
    if not busy.any():
        return None
    return functional.max_pool2d(busy[None].float(), 3, stride=1, padding=1)[0] > 0


def _looked_up(
    capture: Capture, busy: Bool[Tensor, "h w"], track: int, places: Float[Tensor, "n 3"]
) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
    """Whether a camera sees places at all, and whether in busy pixels."""
    camera = capture.camera
    pose = capture.trajectory.pose(torch.zeros(()), torch.tensor(track)).detach().float()
    local = (places - pose[:, 3]) @ pose[:, :3]
    xy = camera.project(local).nan_to_num(-1.0)
    column, row = xy[:, 0].floor().long(), xy[:, 1].floor().long()
    inside = (local[:, 2] > 0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    return inside, busy[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]


def _colours(
    capture: Capture, points: Float[Tensor, "n 3"], time: float
) -> Float[Tensor, "n c"] | None:
    """The mean of what the frames around a time store where points project; None without any."""
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
