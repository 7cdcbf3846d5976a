"""Adaptive density control: clone and split Gaussians where the gradient asks for detail.

The *screen-space gradient* of a Gaussian is that of the loss with respect to the position of its
splat on the image, averaged over the views that saw it. Where it is large, small Gaussians are
cloned and large ones split. Nearly transparent and far too large ones are pruned, and now and then
an *opacity reset* makes all nearly transparent, so that only useful ones come back. At most
`cap_max` are kept; those of the largest gradient densify first. All of it depends on the Gaussians
as they are and on the generator that is passed in.

Source: Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering" (SIGGRAPH
2023). Its released code also prunes what is wide on the image, which later ones leave out.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Generator, Tensor, nn

from sharpfield.core.protocols import Growth, unchanged
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry.se3 import rotation_from_quaternion

PRUNE_OPACITY = 0.005
"""Opacity below which a Gaussian is pruned."""

SPLIT_FACTOR = 1.6
"""Both halves of a split Gaussian are so many times smaller."""

RESET_OPACITY = 0.01
"""Opacity to which all are reduced by an opacity reset."""


class GradientStats(nn.Module):
    """Screen-space gradients of Gaussians since they last densified.

    Args:
        count: Number of Gaussians.
    """

    total: Tensor
    views: Tensor

    def __init__(self, count: int) -> None:
        super().__init__()
        self.register_buffer("total", torch.zeros(count))
        self.register_buffer("views", torch.zeros(count))

    @property
    def mean_grad(self) -> Float[Tensor, "n"]:
        """Mean norm over the views that saw each Gaussian."""
        return self.total / self.views.clamp_min(1)

    def add(self, grad: Float[Tensor, "v n 2"], size: tuple[int, int]) -> None:
        """Add the gradients of some views.

        Args:
            grad: Of the loss by the position of each splat in pixels; zero if not seen.
            size: Width and height of the image. The published threshold is for an image that is
                2 wide and 2 high.
        """
        norm = (grad.detach() * grad.new_tensor(size) / 2).norm(dim=-1)  # [v, n]
        self.total += norm.sum(0)
        self.views += (norm > 0).sum(0)

    def points(self) -> dict[str, Tensor]:
        """The sums, by the names of their buffers."""
        return dict(self.named_buffers())

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Take other sums, for any number of Gaussians."""
        for name, rows in points.items():
            setattr(self, name, rows)

    def cleared(self, growth: Growth) -> Growth:
        """What becomes of this when Gaussians grow: all sums start again at zero."""
        zeros = {name: rows.new_zeros(len(growth)) for name, rows in self.points().items()}
        return replace(growth, values=zeros)


@dataclass(frozen=True)
class DensifyOptions:
    """When Gaussians are cloned, split and pruned. Defaults: the paper's."""

    mean_grad: float = 2e-4
    """Mean screen-space gradient from which on a Gaussian is cloned or split."""
    split_scale: float = 0.01
    """Largest scale, as a fraction of the extent, above which it is split rather than cloned."""
    prune_scale: float = 0.1
    """Largest scale, as a fraction of the extent, above which it is pruned."""


def densify_and_prune(
    gaussians: Gaussians,
    mean_grad: Float[Tensor, "n"],
    extent: float,
    *,
    cap_max: int,
    generator: Generator,
    options: DensifyOptions | None = None,
) -> Growth | None:
    """Clone small and split large Gaussians of large gradient; prune transparent and huge ones.

    Args:
        gaussians: As they are.
        mean_grad: Of each, by `GradientStats`.
        extent: Size of the scene in world units.
        cap_max: Maximum number of Gaussians.
        generator: On the device of the Gaussians.
        options: Thresholds.

    Returns:
        None if all stay as they are.
    """
    options = options or DensifyOptions()
    largest = gaussians.scales.detach().amax(-1)
    keep = gaussians.opacities.detach() >= PRUNE_OPACITY
    keep &= largest <= options.prune_scale * extent
    candidates = keep & (mean_grad >= options.mean_grad)
    order = torch.where(candidates, mean_grad, -1.0).argsort(descending=True, stable=True)
    doubled = torch.zeros_like(candidates)
    doubled[order[: max(cap_max - int(keep.sum()), 0)]] = True  # those of the largest gradient
    doubled &= candidates
    if keep.all() and not doubled.any():
        return None
    split = doubled & (largest > options.split_scale * extent)
    stay = torch.nonzero(keep & ~split)[:, 0]
    clones = torch.nonzero(doubled & ~split)[:, 0]
    halves = torch.nonzero(split)[:, 0].repeat(2)
    source = torch.cat([stay, clones, halves])
    means, scales = gaussians.means.detach()[source], gaussians.log_scales.detach()[source]
    begin = len(source) - len(halves)
    means[begin:] += _sampled_offsets(gaussians, halves, generator)
    scales[begin:] -= math.log(SPLIT_FACTOR)
    fresh = torch.arange(len(source), device=source.device) >= len(stay)
    return Growth(source, fresh, {"means": means, "log_scales": scales})


def reset_opacity(opacity_logits: Float[Tensor, "n"]) -> Growth:
    """Opacity reset: make all Gaussians nearly transparent."""
    most = math.log(RESET_OPACITY / (1 - RESET_OPACITY))
    growth = unchanged(len(opacity_logits), opacity_logits.device)
    return replace(growth, values={"opacity_logits": opacity_logits.detach().clamp_max(most)})


def _sampled_offsets(
    gaussians: Gaussians, rows: Int64[Tensor, "m"], generator: Generator
) -> Float[Tensor, "m 3"]:
    """Offsets from the means, distributed as the Gaussians themselves."""
    normal = torch.randn(len(rows), 3, generator=generator, device=rows.device)
    with torch.no_grad():
        rotation = rotation_from_quaternion(gaussians.quaternions[rows])
        return (rotation @ (gaussians.scales[rows] * normal)[..., None])[..., 0]
