# pyright: basic
"""Tile-based rasterization of Gaussians: on the CPU by our own kernels, on CUDA by gsplat.

On the CPU every Gaussian is projected into all views and listed in the tiles that its splat
overlaps; one entry of such a list is a *touch* (a tile-splat intersection). A tile's touches are
blended from front to back, a row of pixels at a time. In the backward pass each touch writes its
own gradient, and each Gaussian adds up those of its touches in a fixed order: no two threads write
to the same memory, and the sums do not depend on the number of threads.
"""

from math import ceil
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.core.camera import Camera
from sharpfield.core.errors import need
from sharpfield.ops.fast._kernel import memory, spread
from sharpfield.ops.fast._splat_blend import GEOMETRY, LANES, TILE, blend, blend_back
from sharpfield.ops.fast._splat_project import CHUNK, list_touches, project, project_back
from sharpfield.ops.rasterizer import NEAR, WIDEN, Canvas, Drawn, rasterize


@rasterize.accelerate("cpu", needs="numba")
def _(
    means: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    colours: Float[Tensor, "v n c"],
    poses: Float[Tensor, "v 3 4"],
    canvas: Canvas,
    shift: Float[Tensor, "v n 2"] | None = None,
) -> Drawn:
    tensors = (means, quaternions, scales, opacities, colours, poses)
    if any(tensor.dtype != torch.float32 for tensor in tensors):
        return rasterize.reference(*tensors, canvas, shift)
    if shift is None:
        shift = means.new_zeros(()).expand(len(poses), len(means), 2)
    return Drawn(*_Rasterize.apply(canvas, shift, *(tensor.contiguous() for tensor in tensors)))


@rasterize.accelerate("cuda", needs="gsplat")
def _(
    means: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    colours: Float[Tensor, "v n c"],
    poses: Float[Tensor, "v 3 4"],
    canvas: Canvas,
    shift: Float[Tensor, "v n 2"] | None = None,
) -> Drawn:
    tensors = (means, quaternions, scales, opacities, colours, poses)
    if not len(means) or any(tensor.dtype != torch.float32 for tensor in tensors):
        return rasterize.reference(*tensors, canvas, shift)
    gsplat = need("gsplat", extra="gpu", purpose="drawing Gaussians on a GPU")
    camera, (width, height) = canvas.camera, canvas.size
    # All of the image is projected into, so that slopes end where those of the definition do;
    # and a rim around it from which splats may be shifted, as those beyond are left out.
    rim = 0 if shift is None else _rim(shift.detach(), camera)
    wide, high = camera.width + 2 * rim, camera.height + 2 * rim
    reach, centre, depth, conic, thinned = gsplat.fully_fused_projection(
        means, None, quaternions, scales, *_as_matrices(poses, canvas, rim), wide, high,
        eps2d=WIDEN, near_plane=NEAR, calc_compensations=canvas.antialiased,
        opacities=opacities.detach(),
    )  # fmt: skip
    centre = centre - (canvas.corner.to(centre) + rim)[:, None]
    if shift is not None:
        centre = centre + shift
    opacity = opacities.expand(len(poses), -1)
    if canvas.antialiased:
        opacity = opacity * thinned
    tiles = -(-width // TILE), -(-height // TILE)
    _, crossings, order = gsplat.isect_tiles(centre, reach, depth, TILE, *tiles)
    begins = gsplat.isect_offset_encode(crossings, len(poses), *tiles)
    features = torch.cat([colours, depth[..., None]], -1)
    sums, stopped = gsplat.rasterize_to_pixels(
        centre, conic, features, opacity.contiguous(), width, height, TILE, begins, order
    )
    return Drawn(sums[..., :-1], sums[..., -1], stopped[..., 0])


def _rim(shift: Float[Tensor, "v n 2"], camera: Camera) -> int:
    """Pixels by which splats are shifted, at most a quarter of the image."""
    most = min(camera.width, camera.height) // 4
    return min(ceil(float(shift.abs().clamp_max(most).max())), most) if shift.numel() else 0


def _as_matrices(
    poses: Float[Tensor, "v 3 4"], canvas: Canvas, rim: int
) -> tuple[Float[Tensor, "v 4 4"], Float[Tensor, "v 3 3"]]:
    """Camera-from-world matrices, and intrinsics."""
    inward = poses[:, :, :3].mT
    last = poses.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(poses), 1, 4)
    camera_from_world = torch.cat([inward, -inward @ poses[:, :, 3:]], -1)
    camera = canvas.camera
    middle = camera.cx_px + rim, camera.cy_px + rim
    lens = [[camera.fx_px, 0, middle[0]], [0, camera.fy_px, middle[1]], [0, 0, 1]]
    matrix = poses.new_tensor(lens).expand(len(poses), 3, 3)
    return torch.cat([camera_from_world, last], 1), matrix


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, canvas: Canvas, shift: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        means, quaternions, scales, opacities, colours, poses = tensors
        views, count, channels = colours.shape
        gaussians = tuple(memory(t) for t in (means, quaternions, scales, opacities))
        lens, places = _lens(canvas), memory(poses)
        splats = np.empty((views * count, GEOMETRY + channels + 1), np.float32)
        reach = np.empty((views * count, 4), np.int32)
        spread(
            project, gaussians, memory(colours), memory(shift.contiguous()), places, lens,
            (splats, reach),
        )  # fmt: skip
        touched = (reach[:, 1] - reach[:, 0]) * (reach[:, 3] - reach[:, 2])
        slots = np.zeros(views * count + 1, np.int64)
        np.cumsum(touched, out=slots[1:])
        tiles = [-(-side // TILE) for side in canvas.size]
        starts = np.zeros(views * tiles[0] * tiles[1] + 1, np.int64)
        touches = np.empty((slots[-1], 2), np.int32)
        spread(list_touches, splats, reach, slots, (tiles[0], tiles[1]), starts, touches)

        width, height = canvas.size
        images = np.empty((views, height, width, channels + 2), np.float32)
        plan = _shares(starts), starts, touches
        spread(blend, plan, splats, images, LANES, (0,) * (channels + 1))
        ctx.canvas, ctx.drawn = canvas, (plan, splats, slots, images)
        ctx.save_for_backward(shift, *tensors)
        drawn = torch.from_numpy(images)
        # Copies: what is kept for the way back must not change with what the caller was given.
        return drawn[..., :-2].clone(), drawn[..., -2].clone(), 1 - drawn[..., -1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        shift, means, quaternions, scales, opacities, colours, poses = ctx.saved_tensors
        plan, splats, slots, images = ctx.drawn
        views, count, channels = colours.shape
        light, depth, opacity = gradients
        wanted = memory(torch.cat([light, depth[..., None], opacity[..., None]], -1))
        touch_sums = np.empty((slots[-1], splats.shape[1] - 1), np.float32)
        features = (0,) * (channels + 1)
        spread(blend_back, plan, splats, (images, wanted), touch_sums, LANES, features)
        gaussians = tuple(memory(t) for t in (means, quaternions, scales, opacities))
        sums = tuple(torch.empty_like(t) for t in (means, quaternions, scales, opacities))
        of_colours, of_shift = torch.empty_like(colours), torch.empty(views, count, 2)
        of_poses = np.zeros((-(-count // CHUNK), views, 12), np.float32)
        spread(
            project_back, gaussians, memory(poses), _lens(ctx.canvas), (slots, splats, touch_sums),
            tuple(memory(t) for t in (*sums, of_colours, of_shift)), of_poses,
        )  # fmt: skip
        pose_sum = torch.from_numpy(of_poses.sum(0, dtype=np.float64).astype(np.float32))
        return None, of_shift, *sums, of_colours, pose_sum.reshape(views, 3, 4)


def _lens(canvas: Canvas) -> tuple[np.ndarray, np.ndarray, bool]:
    """Focal lengths, largest x/z and y/z, size; principal point in each view's part; mode."""
    camera = canvas.camera
    numbers = [camera.fx_px, camera.fy_px, *canvas.reach(), *canvas.size]
    middle = np.array([camera.cx_px, camera.cy_px]) - canvas.corner.cpu().numpy()
    return np.array(numbers, np.float32), middle.astype(np.float32), canvas.antialiased


def _shares(starts: np.ndarray) -> np.ndarray:
    """First tile of each worker, so that all have about the same number of touches."""
    workers = torch.get_num_threads()
    # A tile without touches costs something, too.
    cost = starts + 8 * np.arange(len(starts))
    cuts = np.searchsorted(cost, cost[-1] * np.arange(1, workers) / workers)
    return np.array([0, *cuts, len(starts) - 1], np.int64)
