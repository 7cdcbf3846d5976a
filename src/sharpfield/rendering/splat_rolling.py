"""Rolling shutter for splats: each Gaussian is projected with the pose at the time of its own row.

The row determines the time, and the pose at that time the row: a fixed-point iteration of two
steps. Shape, colour and depth order are those of the middle row's pose: over a readout they hardly
change, while positions do.

Source: Seiskari et al., "Gaussian Splatting on the Move" (ECCV 2024), with the motion over the
readout as piecewise-linear poses instead of one velocity.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.ops.rasterizer import NEAR

ROUNDS = 2
"""Fixed-point steps; each multiplies the error by about the motion over a readout, in images."""


def row_shift(
    means: Float[Tensor, "n 3"],
    pose: Float[Tensor, "v 3 4"],
    rows: Float[Tensor, "v q 3 4"],
    camera: Camera,
    flat: Camera,
    drift: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "v n 2"]:
    """Shift of splats, in pixels, relative to a global shutter at the middle row's pose.

    Args:
        means: In world axes.
        pose: World-from-camera, of the middle row.
        rows: From the first row to the last, evenly in time.
        camera: The camera with the rolling shutter.
        flat: The pinhole camera that is rendered.
        drift: How far each mean itself moves from the first row to the last; it passes through
            `means` at the middle row. None for static Gaussians.
    """
    last = rows.shape[1] - 1
    middle = _in_camera(means, pose[:, None])[:, 0]
    if drift is not None:
        fraction = torch.linspace(-0.5, 0.5, rows.shape[1], device=means.device, dtype=means.dtype)
        means = means + fraction[:, None, None] * drift  # [q, n, 3]
    by_row = _in_camera(means, rows)  # [v, q, n, 3]
    at, visible = middle, middle[..., 2] > NEAR
    for _ in range(ROUNDS):
        row = camera.project(_ahead(at, visible))[..., 1] / camera.height
        knot = row.clamp(0, 1) * last  # [v, n]
        before = knot.detach().floor().clamp_max(last - 1)
        one, other = (
            by_row.gather(1, (before + k).long()[:, None, :, None].expand(-1, 1, -1, 3))[:, 0]
            for k in (0, 1)
        )
        at = torch.lerp(one, other, (knot - before)[..., None])
        visible = visible & (at[..., 2] > NEAR)
    shift = flat.project(_ahead(at, visible)) - flat.project(_ahead(middle, visible))
    return torch.where(visible[..., None], shift, 0.0)


def _in_camera(
    means: Float[Tensor, "*r n 3"], poses: Float[Tensor, "v q 3 4"]
) -> Float[Tensor, "v q n 3"]:
    """Points in the axes of cameras."""
    return (means - poses[..., None, :, 3]) @ poses[..., :3]


def _ahead(points: Float[Tensor, "v n 3"], visible: Bool[Tensor, "v n"]) -> Float[Tensor, "v n 3"]:
    """Points that can be projected: those that are not visible are moved to the optical axis."""
    return torch.where(visible[..., None], points, points.new_tensor([0.0, 0.0, 1.0]))
