"""Where in space something that moves can be at a moment, as the events of still cameras tell.

A pixel's events add up to how its light differs from that of the first instant. The level where it
stays longest is its *usual* one: that of what stands still. Wherever it is further from it than is
left over between two events, something else is seen: at a moment, these pixels are the
*silhouette* of what moves. A place that a camera sees outside the silhouette is empty, or filled by
something that stands still.

Source: visual hulls, Laurentini (PAMI 1994), with silhouettes from events.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor
from torch.nn import functional

from sharpfield.core.capture import Capture
from sharpfield.events.index import EventIndex
from sharpfield.events.threshold import thresholds_of

BETWEEN = 4
"""Instants looked at from one moment to the next."""

USUAL_SHARE = 0.3
"""Pixels that are at their usual level for less of the time may always see what moves."""

HOLES = 1 / 32
"""Holes in silhouettes are closed up to twice this share of the image: what moves may look like
what is behind it."""

DISSENT = (4, 8)
"""Of so many cameras, one may be wrong about where something can be, and about where it is: what
never leaves a pixel looks as if it stood still."""


@dataclass(frozen=True)
class Hull:
    """Cells of a grid over the box from -1 to 1, at moments evenly spread over the capture."""

    possible: Bool[Tensor, "t d h w"]
    """Something that moves may be within a cell and a moment."""
    solid: Bool[Tensor, "t d h w"]
    """It most likely is there."""


def hull(capture: Capture, index: EventIndex, cells: int, moments: int) -> Hull | None:
    """What cameras that stand still tell; None if there is none that reported anything.

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
        inside, pixel, reach = _look_up(capture, track, points, 2 / (cells - 1))
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
    enough = seen >= min(2, int(seen.max()))
    possible, solid = (
        (enough & (count <= seen // every)).view(moments, cells, cells, cells)
        for count, every in zip(outside, DISSENT, strict=True)
    )
    return Hull(possible, solid & possible)


def silhouettes(
    capture: Capture, index: EventIndex, track: int, instants: int
) -> Bool[Tensor, "t h w"]:
    """Pixels of a still camera that see what moves, at instants evenly spread over the capture."""
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


def _look_up(
    capture: Capture, track: int, points: Float[Tensor, "n 3"], spacing: float
) -> tuple[Bool[Tensor, "n"], Int64[Tensor, "n"], int]:
    """Whether a camera sees points, in which pixels, and how many pixels a spacing is wide."""
    camera = capture.camera
    pose = capture.trajectory.pose(torch.zeros(()), torch.tensor(track)).detach().float()
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = local[:, 2]
    column, row = camera.project(local).nan_to_num(-1.0).floor().long().unbind(-1)
    inside = (depth > 0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    pixel = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
    middle = float(depth.median().clamp_min(1e-6))
    reach = max(math.ceil(spacing / middle * max(camera.fx_px, camera.fy_px)), 1)
    return inside, pixel, reach
