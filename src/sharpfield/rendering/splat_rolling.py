"""Splats where a rolling shutter sees them: each when its own row is read.

The row where a Gaussian is seen says when it was seen, and where the camera was then says the row;
two rounds settle both. Shape, colour and order of depth are those of the middle row's pose: over
a readout they hardly change, while positions do.

Source: Seiskari et al., "Gaussian Splatting on the Move" (ECCV 2024), with the motion over the
readout as a broken line of poses instead of one velocity.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.ops.rasterizer import NEAR

ROUNDS = 2
"""Each leaves a part of the error that is about the image's motion over the readout, in images."""


def row_shift(
    means: Float[Tensor, "n 3"],
    pose: Float[Tensor, "v 3 4"],
    rows: Float[Tensor, "v q 3 4"],
    camera: Camera,
    flat: Camera,
    drift: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "v n 2"]:
    """How far splats lie, in pixels, from where they would be if all rows were read at once.

    Args:
        means: In world axes.
        pose: World-from-camera, of the middle row.
        rows: From the first row to the last, evenly in time.
        camera: Whose rows are read one after the other.
        flat: The pinhole camera that draws.
        drift: How far each mean itself moves from the first row to the last; it passes through
            `means` at the middle row. None for static Gaussians.
    """
    last = rows.shape[1] - 1
    still = _seen_from(means, pose[:, None])[:, 0]
    if drift is not None:
        place = torch.linspace(-0.5, 0.5, rows.shape[1], device=means.device, dtype=means.dtype)
        means = means + place[:, None, None] * drift  # [q, n, 3]
    seen = _seen_from(means, rows)  # [v q n 3]
    at, visible = still, still[..., 2] > NEAR
    for _ in range(ROUNDS):
        row = camera.project(_ahead(at, visible))[..., 1] / camera.height
        place = row.clamp(0, 1) * last
        before = place.detach().floor().clamp_max(last - 1)
        one, other = (
            seen.gather(1, (before + k).long()[:, None, :, None].expand(-1, 1, -1, 3))[:, 0]
            for k in (0, 1)
        )
        at = torch.lerp(one, other, (place - before)[..., None])
        visible = visible & (at[..., 2] > NEAR)
    shift = flat.project(_ahead(at, visible)) - flat.project(_ahead(still, visible))
    return torch.where(visible[..., None], shift, 0.0)


def _seen_from(
    means: Float[Tensor, "*r n 3"], poses: Float[Tensor, "v q 3 4"]
) -> Float[Tensor, "v q n 3"]:
    """In the axes of cameras."""
    return (means - poses[..., None, :, 3]) @ poses[..., :3]


def _ahead(points: Float[Tensor, "v n 3"], visible: Bool[Tensor, "v n"]) -> Float[Tensor, "v n 3"]:
    """Points that can be projected: what is not visible lies on the axis instead."""
    return torch.where(visible[..., None], points, points.new_tensor([0.0, 0.0, 1.0]))
