"""The sharp scene of the splat recipes: Gaussians in the capture's normalised space, and growth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.points import Growth
from sharpfield.core.protocols import PointSet
from sharpfield.core.rays import Radiance, Views
from sharpfield.core.schedule import Group, Schedule, constant, exponential, scaled
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone
from sharpfield.fields.gaussians.densify import GradientStats, densify, fade
from sharpfield.fields.gaussians.mcmc import opacity_scale_penalty, position_noise, relocate_and_add
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.rendering.splat import Splatting

Terms = dict[str, Tensor]

FADE_ROUNDS = 30
"""Rounds of growing after which the classic strategy makes all Gaussians fade."""

EXTENT = 2.0
"""Size of a normalised scene, which what is large or huge is measured by."""

LEAST = 2000
"""Gaussians of a scene that sizes itself by its frames."""

SETTLED = 0.05
"""What is left of a rate at the end of the schedule, relative to where growing ended."""

NO_COOLDOWN = constant(1.0)

SH_REST_SLOWER = 5
"""How much slower colours learn what changes with the direction."""


@dataclass(frozen=True)
class Rates:
    """Learning rates of what Gaussians are made of (Adam)."""

    means: float = 0.016
    """In units of the normalised scene, whose nearest depth is 4/3; falls to a hundredth."""
    quaternions: float = 2e-3
    log_scales: float = 1e-2
    opacities: float = 0.1
    colours: float = 5e-3
    """Of what is the same from everywhere."""


@dataclass(frozen=True)
class GaussianOptions:
    """The Gaussians, how they start and how they grow."""

    budget: int = 0
    """Most of them; 0 takes `density` for every pixel of a frame."""
    density: float = 1 / 3
    """Gaussians for each pixel of a frame, without a budget."""
    degree: int = 1
    """Of the spherical harmonics of colour: 0 looks the same from everywhere, at most 3."""
    start: float = 1.0
    """Part of the budget to start with."""
    size: float = 0.7
    """First scale of each, relative to the distance of its neighbours in an image."""
    opacity: float = 0.1
    """First opacity of each."""
    growth: Literal["markov", "classic", "none"] = "markov"
    """Dead ones move to where live ones are; those that wish to move multiply; or neither."""
    grow_every: int = 100
    """Steps between two rounds of growing."""
    grow_until: float = 0.85
    """Part of the schedule after which their number and places in line stay, nothing shakes or
    frees them any more, and all rates fall so that they come to rest."""
    idle: float = 0.01
    """Weight of mean opacity and of mean scale, with `markov`."""
    noise: float = 5e4
    """Of transparent means relative to their rate, with `markov`; the paper has 5e5."""
    antialiased: bool = True
    """Splats thinner than a pixel are drawn fainter, not just wider."""
    background: float = 0.0
    """Light from behind everything, 0 black to 1 white."""
    rates: Rates = field(default_factory=Rates)


class SplatScene(nn.Module):
    """Gaussians that explain a capture.

    Args:
        options: How many, and how they grow.
        capture: In its normalised space.
        start: Where they begin.
        tone: Of the frames; Gaussians hold stored values.
        steps: Length of the schedule.
        seed: Of the run.
    """

    def __init__(
        self,
        options: GaussianOptions,
        capture: Capture,
        start: Gaussians,
        tone: Tone,
        *,
        steps: int,
        seed: int,
    ) -> None:
        super().__init__()
        self.options, self.capture, self.seed = options, capture, seed
        self.budget = budget_of(options, capture)
        self.gaussians = start
        self.watch = GradientStats(len(self.gaussians)) if options.growth == "classic" else None
        self.splatting = Splatting(
            capture.camera, tone.decode, options.background, options.antialiased
        )
        self.last_growth = int(options.grow_until * steps)
        rates = options.rates
        self.means_rate = exponential(rates.means, rates.means / 100, until=max(steps, 1))
        self.cooldown = cooldown(self.last_growth, steps)
        self.noticed: tuple[Tensor, tuple[int, int]] | None = None

    def draw(self, views: Views) -> Radiance:
        """Linear light of views `[m, k]`, as `[m, h, w, k]`."""
        shift = None
        if self.watch is not None and torch.is_grad_enabled():
            count = views.weight.numel()
            shift = views.pose.new_zeros(count, len(self.gaussians), 2).requires_grad_()
            self.noticed = shift, views.size
        return self.splatting(self.gaussians, views, shift)

    def opacity_scale_penalty(self, step: int) -> Terms:
        """What frees Gaussians of little use, as long as they may move to better places."""
        markov = self.options.growth == "markov"
        if not markov or self.options.idle == 0 or step >= self.last_growth:
            return {}
        return {
            "idle": self.options.idle * torch.stack(opacity_scale_penalty(self.gaussians)).sum()
        }

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """What becomes of the Gaussians after a step."""
        if self.options.growth == "markov":
            return self._share_out(step)
        if self.options.growth == "classic":
            return self._densify(step)
        return []

    def groups(self) -> list[Group]:
        """Parameters with their rates."""
        rates = self.options.rates
        return gaussian_groups(self.gaussians, rates, self.means_rate, self.cooldown)

    def _share_out(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        if step >= self.last_growth:
            return []
        own, options = self.gaussians, self.options
        made = generator(self.seed, step, "growth", own.means.device)
        if options.noise > 0:
            with torch.no_grad():
                own.means.add_(
                    position_noise(own, self.means_rate(step), made, noise=options.noise)
                )
        if not self._round(step):
            return []
        growth = relocate_and_add(
            own.log_scales, own.opacity_logits, budget=self.budget, generator=made
        )
        return [] if growth is None else [(own, growth)]

    def _densify(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        assert self.watch is not None
        if self.noticed is not None:
            shift, size = self.noticed
            if shift.grad is not None:
                self.watch.note(shift.grad, size)
            self.noticed = None
        if not self._round(step):
            return []
        own = self.gaussians
        if (step + 1) % (FADE_ROUNDS * self.options.grow_every) == 0:
            return [(own, fade(own.opacity_logits))]
        made = generator(self.seed, step, "growth", own.means.device)
        growth = densify(own, self.watch.mean_grad, EXTENT, budget=self.budget, generator=made)
        return [] if growth is None else [(own, growth), (self.watch, self.watch.anew(growth))]

    def _round(self, step: int) -> bool:
        return (step + 1) % self.options.grow_every == 0 and step < self.last_growth


def budget_of(options: GaussianOptions, capture: Capture) -> int:
    """Most Gaussians there may be."""
    width, height = capture.camera.size
    return options.budget or max(round(width * height * options.density), LEAST)


def cooldown(begin: int, steps: int, *, left: float = SETTLED) -> Schedule:
    """1, and from a step on down to what is left of it at the end."""
    if begin >= steps:
        return NO_COOLDOWN
    return exponential(1.0, left, begin=begin, until=steps)


def gaussian_groups(
    own: Gaussians, rates: Rates, means_rate: Schedule, settle: Schedule = NO_COOLDOWN
) -> list[Group]:
    """Parameters of Gaussians with their rates, all of which fall as `settle` does."""
    named = {
        "means": (own.means, lambda step: means_rate(step) * settle(step)),
        "quaternions": (own.quaternions, scaled(settle, rates.quaternions)),
        "scales": (own.log_scales, scaled(settle, rates.log_scales)),
        "opacities": (own.opacity_logits, scaled(settle, rates.opacities)),
        "colours": (own.base_harmonics, scaled(settle, rates.colours)),
        "sheen": (own.higher_harmonics, scaled(settle, rates.colours / SH_REST_SLOWER)),
    }
    return [Group(name, (parameter,), rate) for name, (parameter, rate) in named.items()]
