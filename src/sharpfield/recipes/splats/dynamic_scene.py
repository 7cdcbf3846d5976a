"""A moving scene of Gaussians: some stand still, some come and go, before an even background."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.points import Growth
from sharpfield.core.protocols import PointSet
from sharpfield.core.rays import Radiance, Views
from sharpfield.core.schedule import Group, Schedule, constant, exponential, scaled
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone
from sharpfield.events.index import EventIndex
from sharpfield.fields.gaussians.dynamic import GaussianUnion
from sharpfield.fields.gaussians.mcmc import opacity_scale_penalty, position_noise, relocate_and_add
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.initialisation.moving import moving_start, still_start, usual_colour
from sharpfield.recipes.splats.scene import Rates, cooldown, gaussian_groups
from sharpfield.rendering.splat import Splatting

Terms = dict[str, Tensor]

LEAST = 400
"""Gaussians of either kind, however small the frames."""

SLOWER = 0.3
"""Of the rates of velocities and turns, against what would move a Gaussian as far in a span as the
rate of its mean does."""


@dataclass(frozen=True)
class DynamicOptions:
    """The Gaussians of a moving scene, and how they may move."""

    density: float = 0.75
    """Gaussians that stand still, for each pixel of a frame."""
    density_moving: float = 2.25
    """Gaussians that move, for each pixel of a frame, at all times together."""
    degree: int = 0
    """Of the spherical harmonics of those that stand still."""
    span_ms: float = 120.0
    """First span of moving ones, see `fields.moving_gaussians`."""
    size: float = 0.7
    """First scale of still ones, relative to the distance of their neighbours in an image."""
    opacity: float = 0.1
    """First opacity of each."""
    grow_every: int = 100
    """Steps between two rounds in which dead Gaussians move to where live ones are."""
    grow_until: float = 0.85
    """Part of the schedule after which they no longer do, nothing shakes or frees them any more,
    and the rates of all but their paths fall further, so that they come to rest."""
    idle: float = 0.01
    """Weight of mean opacity and of mean scale, of those that stand still."""
    idle_moving: float = 1e-3
    """The same of those that move."""
    fleeting: float = 0.0
    """Weight of how fleeting moving ones are: the mean of the first span over theirs."""
    noise: float = 5e4
    """Of transparent means relative to their rate."""
    rates: Rates = field(default_factory=Rates)
    spans_rate: float = 2e-3
    """Learning rate of the logarithm of spans."""


class DynamicScene(nn.Module):
    """Gaussians that explain a moving scene.

    Args:
        options: How many, and how they move.
        capture: In a world whose box from -1 to 1 holds what moves.
        index: Of its events, if it has any.
        tone: Of the frames; Gaussians hold stored values.
        steps: Length of the schedule.
        still_until: The step from which moving ones are there.
        seed: Of the run.
    """

    def __init__(
        self,
        options: DynamicOptions,
        capture: Capture,
        index: EventIndex | None,
        tone: Tone,
        *,
        steps: int,
        still_until: int,
        seed: int,
    ) -> None:
        super().__init__()
        self.options, self.seed, self.tone = options, seed, tone
        self.still_until = still_until
        pixels = capture.camera.width * capture.camera.height
        still, moving = (
            max(round(density * pixels), LEAST)
            for density in (options.density, options.density_moving)
        )
        self.budgets = {"still": still, "moving": moving}
        self.span = options.span_ms * 1000 / capture.clock.span_us
        opacity = options.opacity
        self.still = still_start(
            capture, tone, still, seed, degree=options.degree, size=options.size, opacity=opacity
        )
        self.moving = moving_start(
            capture, index, tone, moving, seed, span=self.span, opacity=opacity
        )
        self.behind = nn.Parameter(usual_colour(capture, tone))
        self.splatting = Splatting(capture.camera, tone.decode)
        self.last_growth = int(options.grow_until * steps)
        self.cooldown = cooldown(self.last_growth, steps)
        rates = options.rates
        self.means_rate = exponential(rates.means, rates.means / 100, until=max(steps, 1))

    def draw(
        self, views: Views, splatting: Splatting | None = None, *, step: int | None = None
    ) -> Radiance:
        """Linear light of views `[m, k]`, as `[m, h, w, k]`.

        Args:
            views: Those of the same moment are drawn together.
            splatting: Of another camera than the capture's.
            step: Of training; by default it is over.
        """
        alone = step is not None and step < self.still_until
        how = self.splatting if splatting is None else splatting
        return _beside(
            [self._moment(views[:, j : j + 1], how, alone) for j in range(views.shape[1])]
        )

    def _moment(self, views: Views, splatting: Splatting, alone: bool) -> Radiance:
        times = views.time[:, 0]
        if (times != times[0]).any():
            rows = [self._moment(views[i : i + 1], splatting, alone) for i in range(len(times))]
            return Radiance.cat(rows)
        cloud = self.still if alone else GaussianUnion(self.still, self.moving.at(times[0]))
        light = splatting(cloud, views)
        behind = self.tone.decode(self.behind.clamp(0, 1))
        return replace(light, rgb=light.rgb + (1 - light.opacity[..., None]) * behind)

    def terms(self, step: int) -> Terms:
        """What frees Gaussians of little use, and makes those that move last, while they grow."""
        options = self.options
        if step >= self.last_growth:
            return {}
        still, moving = (
            torch.stack(opacity_scale_penalty(part)).sum() for part in (self.still, self.moving)
        )
        idle = options.idle * still + options.idle_moving * moving
        fleeting = (self.span / self.moving.spans).mean()
        return {"idle": idle, "fleeting": options.fleeting * fleeting}

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """What becomes of the Gaussians after a step."""
        found: list[tuple[PointSet, Growth]] = []
        if step >= self.last_growth:
            return found
        on = (step + 1) % self.options.grow_every == 0
        parts: dict[str, Gaussians] = {"still": self.still}
        if step >= self.still_until:
            parts["moving"] = self.moving
        for name, part in parts.items():
            made = generator(self.seed, step, f"growth of what is {name}", part.means.device)
            with torch.no_grad():
                noise = position_noise(part, self.means_rate(step), made, noise=self.options.noise)
                part.means.add_(noise)
            if on:
                growth = relocate_and_add(
                    part.log_scales, part.opacity_logits, budget=self.budgets[name], generator=made
                )
                found += [] if growth is None else [(part, growth)]
        return found

    def groups(self) -> list[Group]:
        """Parameters with their rates."""
        groups, later, rates = [], self._later, self.options.rates
        for name, own, when in (("still", self.still, _always), ("moving", self.moving, later)):
            groups += [
                Group(f"{name} {group.name}", group.parameters, when(group.rate))
                for group in gaussian_groups(own, rates, self.means_rate, self.cooldown)
            ]
        own, pace = self.moving, SLOWER / self.span
        paths = {
            "velocities": (own.velocities, scaled(self.means_rate, pace)),
            "accelerations": (own.accelerations, scaled(self.means_rate, pace / self.span)),
            "jerks": (own.jerks, scaled(self.means_rate, pace / self.span**2)),
            "turns": (own.turns, constant(SLOWER * rates.quaternions / self.span)),
            "moments": (own.moments, scaled(self.means_rate, self.span)),
            "spans": (own.log_spans, constant(self.options.spans_rate)),
        }
        groups += [Group(name, (p,), later(rate)) for name, (p, rate) in paths.items()]
        groups.append(Group("background", (self.behind,), constant(rates.colours)))
        return groups

    def _later(self, rate: Schedule) -> Schedule:
        """A rate, once moving ones are there."""
        return lambda step: rate(step) if step >= self.still_until else 0.0


def _always(rate: Schedule) -> Schedule:
    return rate


def _beside(columns: Sequence[Radiance]) -> Radiance:
    """Views of several instants, side by side along the axis of instants."""
    return Radiance(
        torch.cat([column.rgb for column in columns], -2),
        torch.cat([column.depth for column in columns], -1),
        torch.cat([column.opacity for column in columns], -1),
        torch.cat([column.weight for column in columns], -1),
    )
