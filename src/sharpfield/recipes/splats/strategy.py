"""How Gaussians grow while they train: by MCMC relocation, or by adaptive density control.

A strategy serves one kind of Gaussians, static or moving. After each step it says what becomes of
them; `training.point_growth` then changes parameters and optimizer alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.protocols import Growth, PointSet
from sharpfield.core.schedule import Schedule
from sharpfield.core.seed import generator
from sharpfield.fields.gaussians.densify import GradientStats, densify_and_prune, reset_opacity
from sharpfield.fields.gaussians.mcmc import opacity_scale_penalty, position_noise, relocate_and_add
from sharpfield.fields.gaussians.static import Gaussians

RESET_ROUNDS = 30
"""Rounds of densification after which opacities are reset."""

EXTENT = 2.0
"""Size of a normalised scene, the unit of the scales that split and prune."""

Grown = Sequence[tuple[PointSet, Growth]]


@dataclass(frozen=True)
class GrowthPlan:
    """When one kind of Gaussians grows, and how far."""

    cap_max: int
    """Maximum number of Gaussians."""
    every: int
    """Steps between two rounds of growth."""
    until: int
    """The first step without growth."""
    seed: int
    name: str = "growth"
    """Of the random numbers."""

    def due(self, step: int) -> bool:
        """Whether a round of growth follows a step."""
        return (step + 1) % self.every == 0 and step < self.until


class McmcStrategy(nn.Module):
    """Relocate dead Gaussians, add new ones, and move transparent ones by noise.

    Args:
        plan: When, and how many.
        means_lr: Learning rate of the means.
        noise: Strength of the position noise, relative to it.
        reg: Weight of the penalty on opacity and scale.
    """

    def __init__(self, plan: GrowthPlan, means_lr: Schedule, *, noise: float, reg: float) -> None:
        super().__init__()
        self.plan, self.means_lr, self.noise, self.reg = plan, means_lr, noise, reg

    def penalty(self, gaussians: Gaussians, step: int) -> Float[Tensor, ""] | None:
        """What frees Gaussians of little use, as long as they can be relocated."""
        if self.reg == 0 or step >= self.plan.until:
            return None
        return self.reg * opacity_scale_penalty(gaussians)

    def grow(self, gaussians: Gaussians, step: int) -> Grown:
        """Move means by noise; in some steps, relocate and add."""
        if step >= self.plan.until:
            return []
        made = generator(self.plan.seed, step, self.plan.name, gaussians.means.device)
        if self.noise > 0:
            rate = self.means_lr(step)
            with torch.no_grad():
                gaussians.means.add_(position_noise(gaussians, rate, made, noise=self.noise))
        if not self.plan.due(step):
            return []
        growth = relocate_and_add(
            gaussians.log_scales,
            gaussians.opacity_logits,
            cap_max=self.plan.cap_max,
            generator=made,
        )
        return [] if growth is None else [(gaussians, growth)]


class DensifyStrategy(nn.Module):
    """Clone, split and prune Gaussians by their screen-space gradients; reset opacities.

    Args:
        plan: When, and how many.
        count: Number of Gaussians at the start.
    """

    def __init__(self, plan: GrowthPlan, count: int) -> None:
        super().__init__()
        self.plan, self.stats = plan, GradientStats(count)

    def penalty(self, gaussians: Gaussians, step: int) -> None:
        """None is needed."""

    def grow(self, gaussians: Gaussians, step: int) -> Grown:
        """In some steps, densify and prune, or reset opacities."""
        if not self.plan.due(step):
            return []
        if (step + 1) % (RESET_ROUNDS * self.plan.every) == 0:
            return [(gaussians, reset_opacity(gaussians.opacity_logits))]
        made = generator(self.plan.seed, step, self.plan.name, gaussians.means.device)
        growth = densify_and_prune(
            gaussians, self.stats.mean_grad, EXTENT, cap_max=self.plan.cap_max, generator=made
        )
        if growth is None:
            return []
        return [(gaussians, growth), (self.stats, self.stats.cleared(growth))]


Strategy = McmcStrategy | DensifyStrategy
