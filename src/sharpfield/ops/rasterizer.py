"""Rasterization of Gaussians: splats sorted by depth and blended from front to back.

A *Gaussian* has a mean, a rotation (quaternion w x y z of any length), three scales, an opacity and
a colour for each view. Projected to a camera it is a *splat*: an ellipse whose opacity falls off as
exp(-d/2), d the squared Mahalanobis distance from its centre (the *conic* is the inverse of its
covariance). A *canvas* is the part of a camera's image that is rendered, at a position of its own
for each view.

Source: Zwicker et al., "EWA splatting" (2002); Kerbl et al., "3D Gaussian splatting for real-time
radiance field rendering" (SIGGRAPH 2023); Yu et al., "Mip-Splatting" (CVPR 2024) for the opacity
compensation of the dilation (`antialiased`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.ops._dispatch import Op

NEAR = 0.01
"""Gaussians nearer than this (along the optical axis, in units of the scene) are culled."""

WIDEN = 0.1
"""Added to the variance of every splat, in px^2 (dilation), so that none falls between pixels. A
pixel integrates light over a square, whose variance is 1/12 (Yu et al., "Mip-Splatting", CVPR
2024). The 0.3 of the first paper blurs images beyond their pixels, for which the scene cannot
compensate."""

FAINTEST = 1 / 255
"""A splat with a smaller alpha at a pixel is skipped there."""

MOST = 0.999
"""Largest alpha of a splat at a pixel."""

ASIDE = 1.3
"""The Jacobian of the projection is evaluated at most this many times as far from the optical axis
as the image's corner; farther away the linearisation would diverge."""


@dataclass(frozen=True)
class Canvas:
    """What is rendered: for each view, a part of the image of a pinhole camera."""

    camera: Camera
    corner: Int64[Tensor, "v 2"]
    """Pixel (x, y) at the upper left of each part."""
    size: tuple[int, int]
    """Width and height of the parts in pixels."""
    antialiased: bool = True
    """Dilated splats get a lower opacity, so that their integral stays the same."""

    def __post_init__(self) -> None:
        assert self.camera.lens == "pinhole", "only cameras without distortion are rasterized"

    def reach(self) -> tuple[float, float]:
        """Largest x/z and y/z at which the projection is linearised."""
        camera = self.camera
        x = max(camera.cx_px, camera.width - camera.cx_px) / camera.fx_px
        y = max(camera.cy_px, camera.height - camera.cy_px) / camera.fy_px
        return ASIDE * x, ASIDE * y


class Drawn(NamedTuple):
    """The rendered views."""

    light: Float[Tensor, "v h w c"]
    """Weighted sum of colours, on black."""
    depth: Float[Tensor, "v h w"]
    """Sum of depths along the optical axis, weighted like the colours; divide by the opacity."""
    opacity: Float[Tensor, "v h w"]
    """Share of the light from behind that is absorbed, 0...1."""


class Splats(NamedTuple):
    """Gaussians projected to views."""

    centre: Float[Tensor, "v n 2"]
    """In pixels of the canvas."""
    conic: Float[Tensor, "v n 3"]
    """Elements xx, xy, yy of the inverse covariance."""
    depth: Float[Tensor, "v n"]
    opacity: Float[Tensor, "v n"]
    """At the centre; 0 for Gaussians too near or behind the camera."""


@Op
def rasterize(
    means: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    colours: Float[Tensor, "v n c"],
    poses: Float[Tensor, "v 3 4"],
    canvas: Canvas,
    shift: Float[Tensor, "v n 2"] | None = None,
) -> Drawn:
    """Render Gaussians from several poses; all arguments that are tensors get gradients.

    Args:
        means: In world axes.
        quaternions: w x y z, of any length.
        scales: Standard deviations, positive.
        opacities: 0...1.
        colours: As each view sees them.
        poses: World-from-camera, OpenCV axes.
        canvas: The camera, and the part of its image that is rendered.
        shift: Moves splats on the canvas, in pixels. Zeros that require a gradient collect the
            view-space positional gradients that densification reads.
    """
    splats = project(means, quaternions, scales, opacities, poses, canvas)
    if shift is not None:
        splats = splats._replace(centre=splats.centre + shift)
    return _blend(splats, colours, canvas)


def project(
    means: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    poses: Float[Tensor, "v 3 4"],
    canvas: Canvas,
) -> Splats:
    """Gaussians projected to views (EWA splatting); the arguments are those of `rasterize`."""
    camera = canvas.camera
    inward = poses[:, :, :3].mT  # camera from world
    points = torch.einsum("vij,vnj->vni", inward, means - poses[:, None, :, 3])  # [v, n, 3]
    in_front = points[..., 2] > NEAR
    x, y, _ = points.unbind(-1)
    z = torch.where(in_front, points[..., 2], 1.0)
    focal = points.new_tensor([camera.fx_px, camera.fy_px])
    middle = points.new_tensor([camera.cx_px, camera.cy_px]) - canvas.corner.to(points)
    centre = focal * torch.stack([x / z, y / z], -1) + middle[:, None]  # [v, n, 2]

    reach = canvas.reach()
    aside = [(side / z).clamp(-most, most) for side, most in zip((x, y), reach, strict=True)]
    zero = torch.zeros_like(z)
    jacobian = torch.stack(  # of the projection, [v, n, 2, 3]; 3DGS eq. 5
        [
            torch.stack([focal[0] / z, zero, -focal[0] * aside[0] / z], -1),
            torch.stack([zero, focal[1] / z, -focal[1] * aside[1] / z], -1),
        ],
        -2,
    )
    axes = rotations(quaternions) * scales[:, None]
    root = jacobian @ inward[:, None] @ axes  # [v, n, 2, 3]
    covariance = root @ root.mT  # [v, n, 2, 2]
    widened = covariance + WIDEN * torch.eye(2).to(covariance)
    determinant = widened.det()
    conic = torch.stack(
        [widened[..., 1, 1], -widened[..., 0, 1], widened[..., 0, 0]], -1
    ) / determinant.unsqueeze(-1)
    opacity = opacities.expand_as(determinant)
    if canvas.antialiased:
        # The floor keeps the root's gradient finite for splats seen edge-on.
        before = covariance.det().clamp_min(1e-6)
        opacity = opacity * (before / determinant).sqrt()
    return Splats(centre, conic, points[..., 2], torch.where(in_front, opacity, 0.0))


def _blend(splats: Splats, colours: Float[Tensor, "v n c"], canvas: Canvas) -> Drawn:
    """Alpha compositing of every splat at every pixel, in order of depth (3DGS eq. 3)."""
    width, height = canvas.size
    rows = torch.arange(height).to(colours) + 0.5
    columns = torch.arange(width).to(colours) + 0.5
    dx = columns - splats.centre[..., 0, None, None]
    dy = rows[:, None] - splats.centre[..., 1, None, None]
    a, b, c = (element[..., None, None] for element in splats.conic.unbind(-1))
    fall = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = (splats.opacity[..., None, None] * fall).clamp_max(MOST)
    alpha = torch.where(alpha >= FAINTEST, alpha, 0.0)  # [v n h w]

    order = splats.depth.argsort(dim=1, stable=True)
    alpha = alpha.gather(1, order[..., None, None].expand_as(alpha))
    all_light = alpha.new_ones(len(alpha), 1, height, width)
    transmittance = torch.cumprod(torch.cat([all_light, 1 - alpha], 1), 1)  # [v, n + 1, h, w]
    weight = alpha * transmittance[:, :-1]
    colours = colours.gather(1, order[..., None].expand_as(colours))
    depth = splats.depth.gather(1, order)
    return Drawn(
        torch.einsum("vnhw,vnc->vhwc", weight, colours),
        torch.einsum("vnhw,vn->vhw", weight, depth),
        1 - transmittance[:, -1],
    )


def rotations(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions w x y z of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


@rasterize.exemplify
def _example(generator: torch.Generator, size: int) -> tuple[object, ...]:
    count, views, side = 30 * size, 2, 12 * round(size**0.5)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(count, 3) * torch.tensor([1.2, 1.2, 0.5]) + torch.tensor([0.0, 0.0, 3.0])
    poses = torch.eye(3, 4).repeat(views, 1, 1)
    poses[1, :, 3] = 0.1
    camera = Camera(2 * side, side, float(side), float(side), float(side), side / 2)
    canvas = Canvas(camera, torch.tensor([[0, 0], [3, 1]]), (side + 5, side - 1))
    scales = torch.rand(count, 3, generator=generator) * 0.2 / size**0.5 + 0.02
    opacities = torch.rand(count, generator=generator)
    colours = torch.rand(views, count, 3, generator=generator)
    return means, normal(count, 4), scales, opacities, colours, poses, canvas
