"""Visual hulls: where in space something that moves can be, from the silhouettes of static cameras.

A *silhouette* is the set of pixels of a static camera that see something that moves. A cell of
space that a camera sees outside its silhouette is empty, or holds something static. A cell belongs
to the hull if enough cameras see it within their silhouettes.

There are two ways to silhouettes. *Levels* work at any instant: a pixel's events add up to how its
light differs from that of the first instant. The level where it stays longest is its *usual* one:
that of the static scene. Wherever it is further from it than what is left over between two events,
it sees something else. *Activity* works for windows of time, and with frames: where there are
events, or where a frame differs from the median of its camera's frames.

Moving Gaussians start there: they fill the visual hull of what moves, at all times.

Source: visual hulls, Laurentini (PAMI 1994), with silhouettes from events.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor
from torch.nn import functional

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone
from sharpfield.events.image import window_image
from sharpfield.events.index import EventIndex
from sharpfield.events.threshold import thresholds_of
from sharpfield.fields.gaussians.dynamic import MovingGaussians
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry.trajectory import count_tracks
from sharpfield.initialisation.static_scene import GREY

BETWEEN = 4
"""Silhouettes from one moment of the hull to the next."""

USUAL_SHARE = 0.3
"""Pixels that are at their usual level for less of the time may always see what moves."""

HOLES = 1 / 32
"""Holes in silhouettes are closed up to twice this fraction of the image: what moves may look like
what is behind it."""

DISSENT = (4, 8)
"""Of so many cameras, one may be wrong about where something can be, and about where it is: what
never leaves a pixel looks static."""

ACTIVE_DISSENT = 5
"""The same of silhouettes by activity."""

CHANGED = 0.08
"""Difference of stored values from the median of a camera's frames that makes a pixel active."""

CELLS = 48
"""Cells of the hull of a window, along each axis of the box."""

SPACING = 2 / CELLS


@dataclass(frozen=True)
class Hull:
    """Cells of a grid over the box from -1 to 1, at moments evenly spread over the capture."""

    possible: Bool[Tensor, "t d h w"]
    """Something that moves may be within a cell and a moment."""
    solid: Bool[Tensor, "t d h w"]
    """It most likely is there."""


def carve_visual_hull(capture: Capture, index: EventIndex, cells: int, moments: int) -> Hull | None:
    """The hull at each moment by levels; None if no static camera reported anything.

    Args:
        capture: In a world where the box is around what the cameras look at.
        index: Its events.
        cells: Along each axis of space.
        moments: At least two.
    """
    along = torch.linspace(-1, 1, cells)
    z, y, x = torch.meshgrid(along, along, along, indexing="ij")
    points = torch.stack([x, y, z], -1).view(-1, 3)
    seen = torch.zeros(len(points), dtype=torch.uint8)
    outside = torch.zeros(2, moments, len(points), dtype=torch.uint8)
    for track in range(index.tracks):
        sites = index.sites_of(track)
        silent = index.offset[sites[0]] == index.offset[sites[-1] + 1]
        if silent or capture.trajectory.known_us(track) is not None:
            continue  # a camera that moves sees events everywhere
        inside, pixel, depth = _project(capture, track, points)
        reach = _width_px(capture, depth, 2 / (cells - 1))
        drawn = silhouettes(capture, index, track, BETWEEN * (moments - 1) + 1)
        wide = functional.max_pool3d(
            drawn[None].float(),
            (2 * BETWEEN - 1, 2 * reach + 1, 2 * reach + 1),
            stride=1,
            padding=(BETWEEN - 1, reach, reach),
        )[0].bool()
        seen += inside
        for count, present in zip(outside, (wide, drawn), strict=True):
            count += inside & ~present[::BETWEEN].flatten(1)[:, pixel]
    if not seen.any():
        return None
    possible, solid = (
        _agreed(seen, count, min(2, int(seen.max())), every).view(moments, cells, cells, cells)
        for count, every in zip(outside, DISSENT, strict=True)
    )
    return Hull(possible, solid & possible)


def moving_cells(
    capture: Capture, index: EventIndex | None, window: tuple[float, float]
) -> Float[Tensor, "n 3"] | None:
    """Centres of the cells where something moves in a window of time, by activity.

    Args:
        capture: In a world whose box from -1 to 1 holds what moves.
        index: Of its events, if it has any.
        window: 0...1.

    Returns:
        None if no static camera can tell.
    """
    points = box_cells()
    seen, outside = torch.zeros(len(points)), torch.zeros(len(points))
    for track in range(count_tracks(capture.trajectory)):
        active = active_pixels(capture, index, track, window)
        if active is None:
            continue
        inside, pixel, _ = _project(capture, track, points)
        seen += inside
        outside += inside & ~active.flatten()[pixel]
    kept = (seen > 0) & _agreed(seen, outside, float(seen.max()) / 2, ACTIVE_DISSENT)
    return points[kept] if kept.any() else None


def box_cells() -> Float[Tensor, "n 3"]:
    """Centres of all cells of the box from -1 to 1."""
    along = (torch.arange(CELLS) + 0.5) * SPACING - 1
    return torch.stack(torch.meshgrid(along, along, along, indexing="ij"), -1).view(-1, 3)


def active_pixels(
    capture: Capture, index: EventIndex | None, track: int, window: tuple[float, float]
) -> Bool[Tensor, "h w"] | None:
    """The silhouette of a static camera by activity; None if it moves itself, or cannot tell."""
    if capture.trajectory.known_us(track) is not None:
        return None
    camera = capture.camera
    start, end = (int(capture.clock.us(time)) for time in window)
    active = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    if index is not None and track < index.tracks:
        size = {"width": camera.width, "height": camera.height}
        active |= torch.from_numpy(window_image(index, start, end, track=track, **size).sum(-1) > 0)
    if capture.frames is not None:
        frames, train = capture.frames, capture.split.train
        own = train[frames.track[train] == track]
        middle = frames.exposure.middle_us[own]
        among = own[(middle >= start) & (middle <= end)]
        if len(among) and len(own) > 2:
            images = frames.images[among].astype(np.float32)
            usual = np.median(frames.images[own], 0)
            differs = np.abs(images - usual).max(-1).max(0) > CHANGED * frames.white
            active |= torch.from_numpy(differs)
    if not active.any():
        return None
    return functional.max_pool2d(active[None].float(), 3, stride=1, padding=1)[0] > 0


def silhouettes(
    capture: Capture, index: EventIndex, track: int, instants: int
) -> Bool[Tensor, "t h w"]:
    """Silhouettes of a static camera by levels, at instants evenly spread over the capture."""
    level = _levels(capture, index, track, instants)
    count = np.arange(len(level))
    each = np.zeros((len(level), int(level.max()) + 3), np.int32)  # one to spare at both ends
    np.add.at(each, (count[:, None], level + 1), 1)
    near = each[:, :-2] + each[:, 1:-1] + each[:, 2:]  # left over: up to one event
    usual = (near * (instants + 1) + each[:, 1:-1]).argmax(1)
    away = np.abs(level - usual[:, None]) > 1
    away |= (near[count, usual] < USUAL_SHARE * instants)[:, None]
    camera = capture.camera
    drawn = torch.from_numpy(away).view(camera.height, camera.width, instants).permute(2, 0, 1)
    reach = max(round(HOLES * camera.width), 1)
    wide = functional.max_pool2d(drawn[None].float(), 2 * reach + 1, stride=1, padding=reach)
    return -functional.max_pool2d(-wide, 2 * reach + 1, stride=1, padding=reach)[0] > 0.5


def _levels(
    capture: Capture, index: EventIndex, track: int, instants: int
) -> Int32[np.ndarray, "p t"]:
    """Log light of each pixel in mean thresholds, rounded, from the lowest of all on."""
    sites = index.sites_of(track)
    offset = index.offset[sites[0] : sites[-1] + 2]
    t_us, polarity = (part[offset[0] : offset[-1]] for part in (index.t_us, index.p))
    site = np.repeat(np.arange(len(sites)), np.diff(offset))
    darker, brighter = thresholds_of(capture, None)
    step = np.where(polarity > 0, brighter, -darker) * (2 / (darker + brighter))
    first = np.ceil(np.clip(capture.clock.unit(t_us), 0, 1) * (instants - 1)).astype(np.int64)
    change = np.zeros((len(sites), instants), np.float32)
    np.add.at(change, (site, first), step.astype(np.float32))
    level = np.rint(change.cumsum(1)).astype(np.int32)
    return level - level.min()


def _project(
    capture: Capture, track: int, points: Float[Tensor, "n 3"]
) -> tuple[Bool[Tensor, "n"], Int64[Tensor, "n"], Float[Tensor, "n"]]:
    """Whether a static camera sees points, in which pixels (row by row), and at which depth."""
    pose = capture.trajectory.pose(torch.zeros(()), torch.tensor(track)).detach().float()
    return _pixels_of(capture.camera, pose, points)


def _pixels_of(
    camera: Camera, pose: Float[Tensor, "3 4"], points: Float[Tensor, "n 3"]
) -> tuple[Bool[Tensor, "n"], Int64[Tensor, "n"], Float[Tensor, "n"]]:
    """The same of a camera with a given pose."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = local[:, 2]
    column, row = camera.project(local).nan_to_num(-1.0).floor().long().unbind(-1)
    inside = (depth > 0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    pixel = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
    return inside, pixel, depth


def _width_px(capture: Capture, depth: Float[Tensor, "n"], spacing: float) -> int:
    """How many pixels a spacing is wide at the median depth."""
    middle = float(depth.median().clamp_min(1e-6))
    camera = capture.camera
    return max(math.ceil(spacing / middle * max(camera.fx_px, camera.fy_px)), 1)


def _agreed(seen: Tensor, outside: Tensor, least: int | float, every: int) -> Bool[Tensor, "*b n"]:
    """Cells that enough cameras see, all but one of `every` within their silhouettes."""
    return (seen >= least) & (outside <= seen // every)


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
        inside, pixel, _ = _pixels_of(capture.camera, pose, points)
        image = torch.from_numpy(frames.images[frame].astype(np.float32)) / frames.white
        total[inside] += image.flatten(0, 1)[pixel[inside]]
        count += inside
    return total / count.clamp_min(1)[:, None]
