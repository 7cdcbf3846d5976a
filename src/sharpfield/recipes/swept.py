"""Where in space something can have moved, as the events of cameras that stand still tell.

What moves through a place covers the pixels that see it and uncovers them again, which makes events
there. A place that some camera sees in a pixel without any event has only ever been empty, or
filled by something that stands still.

Source: visual hulls, Laurentini (PAMI 1994), with events in place of silhouettes.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sharpfield.core.capture import Capture
from sharpfield.ops.event_index import EventIndex


def swept(capture: Capture, index: EventIndex, cells: int) -> Bool[Tensor, "d h w"]:
    """Which cells of a grid over the box from -1 to 1 something may have passed.

    Args:
        capture: In a world where the box is around what the cameras look at.
        index: Its events.
        cells: Along each axis.
    """
    along = torch.linspace(-1, 1, cells)
    z, y, x = torch.meshgrid(along, along, along, indexing="ij")
    points = torch.stack([x, y, z], -1)  # [d, h, w, 3]
    possible = torch.ones(cells, cells, cells, dtype=torch.bool)
    seen = torch.zeros_like(possible)
    for track in range(index.tracks):
        busy = _busy(capture, index, track)
        if capture.trajectory.known_us(track) is not None or not busy.any():
            continue  # a camera that moves sees events everywhere
        pose = capture.trajectory.pose(torch.zeros(()), torch.tensor(track)).detach().float()
        inside, active = _look_up(capture, pose, busy, points, 2 / (cells - 1))
        possible &= active | ~inside
        seen |= inside
    return possible & seen if seen.any() else possible


def _busy(capture: Capture, index: EventIndex, track: int) -> Bool[Tensor, "h w"]:
    """Pixels of a camera that reported anything at all."""
    sites = index.sites_of(track)
    each = torch.from_numpy(index.offset[sites + 1] - index.offset[sites])
    return (each > 0).view(capture.camera.height, capture.camera.width)


def _look_up(
    capture: Capture,
    pose: Float[Tensor, "3 4"],
    busy: Bool[Tensor, "h w"],
    points: Float[Tensor, "*b 3"],
    spacing: float,
) -> tuple[Bool[Tensor, "*b"], Bool[Tensor, "*b"]]:
    """Whether a camera sees points at all, and whether pixels within a cell of them are busy."""
    camera = capture.camera
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = local[..., 2]
    xy = camera.project(local).nan_to_num(-1.0)
    column, row = xy[..., 0].floor().long(), xy[..., 1].floor().long()
    inside = (depth > 0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    middle = float(depth.median().clamp_min(1e-6))
    reach = max(math.ceil(spacing / middle * max(camera.fx_px, camera.fy_px)), 1)
    wide = functional.max_pool2d(busy[None].float(), 2 * reach + 1, stride=1, padding=reach)[0] > 0
    return inside, wide[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
