"""The scene of all recipes on Gaussians: static ones, moving ones if there are any, a background.

A static scene is a moving scene without motion. Views of one time are rendered together; with
moving Gaussians, those of different times one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Terms
from sharpfield.core.protocols import Growth, PointSet
from sharpfield.core.rays import Radiance, Views
from sharpfield.core.schedule import Group, Schedule, constant, exponential, scaled
from sharpfield.core.tone import Tone
from sharpfield.fields.gaussians.dynamic import GaussianUnion, MovingGaussians
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry.rolling import Rolling
from sharpfield.initialisation.static_scene import background_colour
from sharpfield.recipes.splats.strategy import DensifyStrategy, GrowthPlan, McmcStrategy, Strategy
from sharpfield.rendering.splat import Cloud, Splatting

COOLED = 0.05
"""What is left of a learning rate at the end of the schedule, relative to where growth ended."""

NO_COOLDOWN = constant(1.0)

SH_REST_SLOWER = 5
"""How many times slower the higher spherical harmonics learn."""

PATHS_SLOWER = 0.3
"""Factor on the learning rates of paths, against those that would move a Gaussian as far in a
lifespan as the learning rate of its mean does."""


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of the parameters of Gaussians (Adam)."""

    means: float = 0.016
    """In units of the normalised scene, whose nearest depth is 4/3; falls to a hundredth."""
    quaternions: float = 2e-3
    """Of rotations, as quaternions of any length."""
    log_scales: float = 1e-2
    """Of the natural log of scales."""
    opacities: float = 0.1
    """Of the logit of opacities."""
    colours: float = 5e-3
    """Of the harmonics of SH degree 0; the higher ones learn 5 times slower."""


@dataclass(frozen=True)
class GaussianOptions:
    """The Gaussians, how they start and how they grow."""

    cap_max: int = 0
    """Maximum number of static Gaussians; 0 takes `density` for every pixel of a frame."""
    density: float = 1 / 3
    """Static Gaussians per pixel of a frame, where `cap_max` is 0."""
    min_count: int = 2000
    """Least maximum number, however small the frames."""
    sh_degree: int = 1
    """SH degree of the colour of static Gaussians: 0 is the same from all directions; at most 3."""
    start: float = 1.0
    """Number of Gaussians to start with, as a fraction of the maximum."""
    scale: float = 0.7
    """First scale, relative to the distance of a Gaussian's neighbours in an image."""
    opacity: float = 0.1
    """First opacity."""
    growth: Literal["mcmc", "densify", "none"] = "mcmc"
    """`mcmc` relocates dead Gaussians to live ones; `densify` clones, splits and prunes by
    screen-space gradients."""
    grow_every: int = 100
    """Steps between two rounds of growth."""
    grow_until: float = 0.85
    """Fraction of the schedule after which nothing is relocated, added or pruned, noise and penalty
    end, and all learning rates fall to a twentieth."""
    reg: float = 0.01
    """Weight of mean opacity and of mean scale, with `mcmc`."""
    noise: float = 5e4
    """Position noise of transparent Gaussians relative to the learning rate of the means, with
    `mcmc`; the paper has 5e5."""
    antialiased: bool = True
    """Splats thinner than a pixel are rendered fainter, not just wider (Mip-Splatting)."""
    background: float | None = 0.0
    """Light behind everything, 0 black to 1 white; None learns its colour."""
    lr: LearningRates = field(default_factory=LearningRates)

    def count(self, capture: Capture) -> int:
        """Maximum number of static Gaussians on a capture."""
        width, height = capture.camera.size
        return self.cap_max or max(round(width * height * self.density), self.min_count)


@dataclass(frozen=True)
class MotionOptions:
    """The moving Gaussians of a scene."""

    density: float = 2.25
    """Moving Gaussians per pixel of a frame, those of all times together."""
    lifespan_ms: float = 120.0
    """First lifespan, see `fields.gaussians.dynamic`."""
    static_warmup: float = 0.15
    """Fraction of the schedule in which static Gaussians learn alone, if there are frames: what a
    camera sees most of the time."""
    reg: float = 1e-3
    """Weight of mean opacity and of mean scale of moving Gaussians, with `mcmc`."""
    lifespan_penalty: float = 0.0
    """Weight of the mean of the first lifespan over each Gaussian's own: favours long ones."""
    lifespan_lr: float = 2e-3
    """Learning rate of the logarithm of lifespans."""

    def count(self, options: GaussianOptions, capture: Capture) -> int:
        """Maximum number of moving Gaussians on a capture."""
        width, height = capture.camera.size
        return max(round(width * height * self.density), options.min_count)

    def lifespan(self, capture: Capture) -> float:
        """The first lifespan as a fraction of the capture."""
        return self.lifespan_ms * 1000 / capture.clock.span_us


@dataclass(frozen=True)
class _ScreenGrad:
    """Where the gradient of some views by the positions of splats will be."""

    shift: Float[Tensor, "v n 2"]
    size: tuple[int, int]
    active: Bool[Tensor, "m"] | None
    """Which moving Gaussians follow the static ones in n; None for none."""


class SplatScene(nn.Module):
    """Gaussians that explain a capture.

    Args:
        options: How many, and how they grow.
        capture: In the model's space.
        static: Where static Gaussians start.
        moving: Where moving ones start, with their options; None for a static scene.
        tone: Of the frames; Gaussians hold stored values.
        steps: Length of the schedule.
        seed: Of the run.
    """

    def __init__(
        self,
        options: GaussianOptions,
        capture: Capture,
        static: Gaussians,
        moving: tuple[MovingGaussians, MotionOptions] | None,
        tone: Tone,
        *,
        steps: int,
        seed: int,
    ) -> None:
        super().__init__()
        self.options, self.tone = options, tone
        self.static = static
        self.moving, self.motion = (None, None) if moving is None else moving
        self.background = None
        if options.background is None:
            self.background = nn.Parameter(background_colour(capture, tone))
        self.splatting = Splatting(
            capture.camera, tone.decode, options.background or 0.0, options.antialiased
        )
        self.readout = Rolling.of(capture).readout
        self.moving_from, self.lifespan = 0, 1.0
        if self.motion is not None:
            # Without frames nothing shows what is static but what passes before it.
            warmup = 0.0 if capture.frames is None else self.motion.static_warmup
            self.moving_from, self.lifespan = int(warmup * steps), self.motion.lifespan(capture)
        self.last_growth = int(options.grow_until * steps)
        self.cooldown = cooldown(self.last_growth, steps)
        rate = options.lr.means
        self.means_lr = exponential(rate, rate / 100, until=max(steps, 1))
        self.strategies = nn.ModuleDict()
        plan = GrowthPlan(options.count(capture), options.grow_every, self.last_growth, seed)
        self._add_strategy("static", static, plan, options.reg)
        if self.moving is not None and self.motion is not None:
            count = self.motion.count(options, capture)
            plan = replace(plan, cap_max=count, name="growth of moving")
            self._add_strategy("moving", self.moving, plan, self.motion.reg)
        self._screen_grads: list[_ScreenGrad] = []

    def _add_strategy(self, name: str, own: Gaussians, plan: GrowthPlan, reg: float) -> None:
        if self.options.growth == "mcmc":
            noise = self.options.noise
            self.strategies[name] = McmcStrategy(plan, self.means_lr, noise=noise, reg=reg)
        elif self.options.growth == "densify":
            self.strategies[name] = DensifyStrategy(plan, len(own))

    def draw(
        self, views: Views, camera: Camera | None = None, *, step: int | None = None
    ) -> Radiance:
        """Linear light of views `[m, k]`, as `[m, h, w, k]`.

        Args:
            views: Those of one time are rendered together.
            camera: Another one than the capture's.
            step: Of training; by default it is over.
        """
        how = self.splatting if camera is None else replace(self.splatting, camera=camera)
        if self.moving is None or (step is not None and step < self.moving_from):
            light = self._render(self.static, views, how, step)
        else:
            columns = [views[:, j : j + 1] for j in range(views.shape[1])]
            parts = [self._render_moving(self.moving, v, how, step) for v in columns]
            light = Radiance.cat(parts, axis=3)  # [m, h, w, k]
        if self.background is None:
            return light
        behind = self.tone.decode(self.background.clamp(0, 1))
        return replace(light, rgb=light.rgb + (1 - light.opacity[..., None]) * behind)

    def _render_moving(
        self, moving: MovingGaussians, views: Views, splatting: Splatting, step: int | None
    ) -> Radiance:
        """Views `[m, 1]`, each at its own time."""
        times = views.time[:, 0]
        if (times != times[0]).any():
            rows = [views[i : i + 1] for i in range(len(times))]
            return Radiance.cat([self._render_moving(moving, v, splatting, step) for v in rows])
        readout = 0.0 if views.rows is None else self.readout
        now = GaussianUnion(self.static, moving.at(times[0] + readout / 2))  # of the middle row
        drift = now.velocities * readout if readout else None
        return self._render(now, views, splatting, step, now.moving.active, drift)

    def _render(
        self,
        cloud: Cloud,
        views: Views,
        splatting: Splatting,
        step: int | None,
        active: Bool[Tensor, "m"] | None = None,
        drift: Float[Tensor, "n 3"] | None = None,
    ) -> Radiance:
        shift = None
        if self.options.growth == "densify" and step is not None and torch.is_grad_enabled():
            count = views.weight.numel(), len(cloud.means), 2
            shift = views.pose.new_zeros(count).requires_grad_()
            self._screen_grads.append(_ScreenGrad(shift, views.size, active))
        return splatting(cloud, views, shift, drift)

    def gaussians_at(self, time: float) -> Gaussians:
        """The Gaussians at a time, 0...1 of the capture, as if nothing moved."""
        if self.moving is None:
            return self.static
        return self.static.joined(self.moving.frozen_at(time, sh_degree=self.static.sh_degree))

    def penalties(self, step: int) -> Terms:
        """Penalties that free Gaussians of little use, as long as they can be relocated."""
        found = [
            penalty
            for own, strategy in self._kinds()
            if (penalty := strategy.penalty(own, step)) is not None
        ]
        terms = {"reg": torch.stack(found).sum()} if found else {}
        motion, moving = self.motion, self.moving
        if moving is not None and motion is not None and step < self.last_growth:
            shortness = (self.lifespan / moving.lifespans).mean()
            terms["lifespan"] = motion.lifespan_penalty * shortness
        return terms

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """What becomes of the Gaussians after a step."""
        self._note_gradients()
        grown: list[tuple[PointSet, Growth]] = []
        for own, strategy in self._kinds():
            if own is self.static or step >= self.moving_from:
                grown += strategy.grow(own, step)
        return grown

    def _kinds(self) -> list[tuple[Gaussians, Strategy]]:
        """Static and moving Gaussians that grow, each with its strategy."""
        kinds = {"static": self.static, "moving": self.moving}
        return [(kinds[name], how) for name, how in self.strategies.items()]  # pyright: ignore

    def _note_gradients(self) -> None:
        """Add the screen-space gradients of a step to the statistics of each strategy."""
        for view in self._screen_grads:
            if (grad := view.shift.grad) is None:
                continue
            for own, strategy in self._kinds():
                assert isinstance(strategy, DensifyStrategy)
                if own is self.static:
                    strategy.stats.add(grad[:, : len(own)], view.size)
                elif view.active is not None:
                    every = grad.new_zeros(len(grad), len(own), 2)
                    every[:, view.active] = grad[:, len(self.static) :]
                    strategy.stats.add(every, view.size)
        self._screen_grads.clear()

    def groups(self) -> list[Group]:
        """Parameters with their learning rates."""
        groups = _groups(self.static, self.options.lr, self.means_lr, self.cooldown)
        if self.moving is not None and self.motion is not None:
            own = _groups(self.moving, self.options.lr, self.means_lr, self.cooldown)
            own += _path_groups(
                self.moving, self.options.lr, self.means_lr, self.motion, self.lifespan
            )
            groups += [
                Group(f"moving {group.name}", group.parameters, _from(self.moving_from, group.rate))
                for group in own
            ]
        if self.background is not None:
            rate = constant(self.options.lr.colours)
            groups.append(Group("background", (self.background,), rate))
        return groups


def cooldown(begin: int, steps: int, *, left: float = COOLED) -> Schedule:
    """1, and from a step on falling to what is left of it at the end."""
    if begin >= steps:
        return NO_COOLDOWN
    return exponential(1.0, left, begin=begin, until=steps)


def _groups(
    own: Gaussians, lr: LearningRates, means_lr: Schedule, cooldown: Schedule
) -> list[Group]:
    """Parameters of Gaussians with their learning rates, all of which cool down."""
    named = {
        "means": (own.means, lambda step: means_lr(step) * cooldown(step)),
        "quaternions": (own.quaternions, scaled(cooldown, lr.quaternions)),
        "scales": (own.log_scales, scaled(cooldown, lr.log_scales)),
        "opacities": (own.opacity_logits, scaled(cooldown, lr.opacities)),
        "colours": (own.base_harmonics, scaled(cooldown, lr.colours)),
        "sh_rest": (own.higher_harmonics, scaled(cooldown, lr.colours / SH_REST_SLOWER)),
    }
    return [Group(name, (parameter,), rate) for name, (parameter, rate) in named.items()]


def _path_groups(
    own: MovingGaussians,
    lr: LearningRates,
    means_lr: Schedule,
    motion: MotionOptions,
    lifespan: float,
) -> list[Group]:
    """Paths and lifespans of moving Gaussians with their learning rates; none cool down."""
    pace = PATHS_SLOWER / lifespan
    named = {
        "velocities": (own.velocities, scaled(means_lr, pace)),
        "accelerations": (own.accelerations, scaled(means_lr, pace / lifespan)),
        "jerks": (own.jerks, scaled(means_lr, pace / lifespan**2)),
        "angular_velocities": (own.angular_velocities, constant(pace * lr.quaternions)),
        "centre_times": (own.centre_times, scaled(means_lr, lifespan)),
        "lifespans": (own.log_lifespans, constant(motion.lifespan_lr)),
    }
    return [Group(name, (parameter,), rate) for name, (parameter, rate) in named.items()]


def _from(begin: int, rate: Schedule) -> Schedule:
    """A learning rate, and 0 before a step."""
    return lambda step: rate(step) if step >= begin else 0.0
