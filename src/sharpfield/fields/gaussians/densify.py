"""Gaussians multiply where they want to move: small ones are cloned, large ones split.

How much a Gaussian *wishes* to move is the gradient of the loss by its place on the image,
averaged over the views that saw it. What is nearly transparent or far too large is dropped, and
now and then all are made to `fade`, so that only those of use come back. At most a budget of them
is kept; those that wish most come first. All of it depends on the Gaussians as they are and on the
generator that is passed in.

Source: Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering" (SIGGRAPH
2023). Its released code also drops what is wide on the image, which later ones leave out.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Generator, Tensor, nn

from sharpfield.core.points import Growth, unchanged
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry.se3 import rotation_from_quaternion

DEAD = 0.005
"""Opacity below which a Gaussian is dropped."""

SPLIT = 1.6
"""Both halves of a split Gaussian are so many times smaller."""

FADED = 0.01
"""Opacity to which all are reduced now and then."""


class GradientStats(nn.Module):
    """How much Gaussians have wished to move since they last multiplied.

    Args:
        count: Number of Gaussians.
    """

    total: Tensor
    times: Tensor

    def __init__(self, count: int) -> None:
        super().__init__()
        self.register_buffer("total", torch.zeros(count))
        self.register_buffer("times", torch.zeros(count))

    @property
    def mean_grad(self) -> Float[Tensor, "n"]:
        """Mean over the views that saw each Gaussian."""
        return self.total / self.times.clamp_min(1)

    def note(self, pull: Float[Tensor, "v n 2"], size: tuple[int, int]) -> None:
        """Remember some views.

        Args:
            pull: Gradient of the loss by the place of each splat in pixels; zero if not seen.
            size: Width and height of the image. The published threshold is for an image that is
                2 wide and 2 high.
        """
        far = (pull.detach() * pull.new_tensor(size) / 2).norm(dim=-1)  # [v, n]
        self.total += far.sum(0)
        self.times += (far > 0).sum(0)

    def points(self) -> dict[str, Tensor]:
        """The sums, by the names of their buffers."""
        return dict(self.named_buffers())

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Take other sums, for any number of Gaussians."""
        for name, rows in points.items():
            setattr(self, name, rows)

    def anew(self, growth: Growth) -> Growth:
        """What becomes of this when Gaussians grow: it forgets what it has seen."""
        nothing = {name: rows.new_zeros(len(growth)) for name, rows in self.points().items()}
        return replace(growth, values=nothing)


@dataclass(frozen=True)
class DensifyOptions:
    """When Gaussians are cloned, split and dropped. Defaults: the paper's."""

    mean_grad: float = 2e-4
    """Wish to move from which on a Gaussian is doubled."""
    large: float = 0.01
    """Largest scale, as a fraction of the extent, above which it is split rather than cloned."""
    huge: float = 0.1
    """Largest scale, as a fraction of the extent, above which it is dropped."""


def densify(
    gaussians: Gaussians,
    mean_grad: Float[Tensor, "n"],
    extent: float,
    *,
    budget: int,
    generator: Generator,
    options: DensifyOptions | None = None,
) -> Growth | None:
    """Clone small and split large Gaussians that wish to move; drop transparent and huge ones.

    Args:
        gaussians: As they are.
        mean_grad: Of each, by `GradientStats`.
        extent: Size of the scene in world units.
        budget: Most Gaussians there may be.
        generator: On the device of the Gaussians.
        options: Thresholds.

    Returns:
        None if all stay as they are.
    """
    options = options or DensifyOptions()
    largest = gaussians.scales.detach().amax(-1)
    useful = (gaussians.opacities.detach() >= DEAD) & (largest <= options.huge * extent)
    doubled = _doubled(
        mean_grad, useful & (mean_grad >= options.mean_grad), budget - int(useful.sum())
    )
    if useful.all() and not doubled.any():
        return None
    split = doubled & (largest > options.large * extent)
    stay = torch.nonzero(useful & ~split)[:, 0]
    clones = torch.nonzero(doubled & ~split)[:, 0]
    halves = torch.nonzero(split)[:, 0].repeat(2)
    source = torch.cat([stay, clones, halves])
    means, scales = gaussians.means.detach()[source], gaussians.log_scales.detach()[source]
    begin = len(source) - len(halves)
    means[begin:] += _inside(gaussians, halves, generator)
    scales[begin:] -= math.log(SPLIT)
    fresh = torch.arange(len(source), device=source.device) >= len(stay)
    return Growth(source, fresh, {"means": means, "log_scales": scales})


def fade(opacity_logits: Float[Tensor, "n"]) -> Growth:
    """Make all Gaussians nearly transparent."""
    most = math.log(FADED / (1 - FADED))
    growth = unchanged(len(opacity_logits), opacity_logits.device)
    return replace(growth, values={"opacity_logits": opacity_logits.detach().clamp_max(most)})


def _doubled(
    mean_grad: Float[Tensor, "n"], wishing: Bool[Tensor, "n"], room: int
) -> Bool[Tensor, "n"]:
    """Those of the wishing that there is room for."""
    order = torch.where(wishing, mean_grad, -1.0).argsort(descending=True, stable=True)
    allowed = torch.zeros_like(wishing)
    allowed[order[: max(room, 0)]] = True
    return wishing & allowed


def _inside(
    gaussians: Gaussians, rows: Int64[Tensor, "m"], generator: Generator
) -> Float[Tensor, "m 3"]:
    """Offsets from the means, distributed as the Gaussians themselves."""
    normal = torch.randn(len(rows), 3, generator=generator, device=rows.device)
    with torch.no_grad():
        turn = rotation_from_quaternion(gaussians.quaternions[rows])
        return (turn @ (gaussians.scales[rows] * normal)[..., None])[..., 0]
