"""Moving Gaussians: each lives around a centre time and moves along a polynomial.

At its *centre time* a Gaussian is where its mean says, and most opaque. Before and after, its mean
follows a cubic polynomial and it rotates at a constant rate. Its opacity is constant for most of
its *lifespan* and then falls fast, as exp(-d^4/2), d the time from the centre in lifespans. What is
visible for longer is handed from one Gaussian to the next, so that no motion is too long or too
intricate.

Source: Li et al., "Spacetime Gaussian feature splatting" (CVPR 2024), eqs. 6 to 9, with stored
colours instead of features, and without their slow fading as exp(-d^2/2), in which several
Gaussians of different times overlap and blur what they show.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sharpfield.fields.gaussians.static import Gaussians

MAX_AGE = 1.9
"""Lifespans from the centre time beyond which a Gaussian is nearly transparent and not rendered."""


class MovingGaussians(Gaussians):
    """Gaussians with centre times, lifespans and paths; their colour is the same in all directions.

    Args:
        base: As they are at their centre times; of SH degree 0.
        centre_times: 0...1 of the capture.
        lifespan: First lifespan of all, as a fraction of the capture.
    """

    def __init__(
        self, base: Gaussians, centre_times: Float[Tensor, "n"], *, lifespan: float
    ) -> None:
        super().__init__(
            base.means.detach(),
            base.quaternions.detach(),
            base.log_scales.detach(),
            base.opacity_logits.detach(),
            base.harmonics.detach(),
        )
        zeros = torch.zeros_like(self.means)
        self.centre_times = nn.Parameter(centre_times.float().clone())
        self.log_lifespans = nn.Parameter(torch.full_like(self.centre_times, math.log(lifespan)))
        # Per duration of the capture, its square and its cube.
        self.velocities = nn.Parameter(zeros.clone())
        self.accelerations = nn.Parameter(zeros.clone())
        self.jerks = nn.Parameter(zeros.clone())
        self.angular_velocities = nn.Parameter(zeros.clone())
        """Rotation vectors per duration of the capture, in world axes."""

    @property
    def lifespans(self) -> Float[Tensor, "n"]:
        """As fractions of the capture."""
        return self.log_lifespans.exp()

    def at(self, time: float | Float[Tensor, ""]) -> "GaussiansAtTime":
        """The Gaussians that are visible at a time, 0...1 of the capture."""
        since = time - self.centre_times
        age = since / self.lifespans
        active = age.detach().abs() < MAX_AGE
        since, age = since[active, None], age[active]  # [a, 1], [a]
        velocity, acceleration, jerk = (
            rows[active] for rows in (self.velocities, self.accelerations, self.jerks)
        )
        rotation = quaternion_of(self.angular_velocities[active] * since)
        return GaussiansAtTime(
            means=self.means[active]
            + since * (velocity + since * (acceleration / 2 + since * jerk / 6)),
            quaternions=quaternion_product(rotation, self.quaternions[active]),
            scales=self.scales[active],
            opacities=self.opacities[active] * torch.exp(-0.5 * age**4),
            velocities=velocity + since * (acceleration + since * jerk / 2),
            gaussians=self,
            active=active,
        )

    def frozen_at(self, time: float, *, sh_degree: int = 0) -> Gaussians:
        """Static Gaussians that look as these do at a time.

        Args:
            time: 0...1 of the capture.
            sh_degree: Of the result, whose higher harmonics are zero.
        """
        with torch.no_grad():
            seen = self.at(time)
            base = self.harmonics[seen.active]  # [a, 1, c]
            higher = base.new_zeros(len(base), (sh_degree + 1) ** 2 - 1, base.shape[-1])
            return Gaussians(
                seen.means,
                seen.quaternions,
                seen.scales.log(),
                seen.opacities.logit(),
                torch.cat([base, higher], 1),
            )


@dataclass(frozen=True)
class GaussiansAtTime:
    """Moving Gaussians at one time: the a of m that are visible then."""

    means: Float[Tensor, "a 3"]
    quaternions: Float[Tensor, "a 4"]
    scales: Float[Tensor, "a 3"]
    opacities: Float[Tensor, "a"]
    velocities: Float[Tensor, "a 3"]
    """Of the means, in world units per duration of the capture."""
    gaussians: MovingGaussians
    active: Bool[Tensor, "m"]
    """Which of all moving Gaussians these are."""

    def colours(self, seen_from: Float[Tensor, "v 3"]) -> Float[Tensor, "v a c"]:
        """Stored values, see `Gaussians.colours`."""
        return self.gaussians.colours(seen_from)[:, self.active]


@dataclass(frozen=True)
class GaussianUnion:
    """Static Gaussians, and moving ones at one time."""

    static: Gaussians
    moving: GaussiansAtTime

    @property
    def means(self) -> Float[Tensor, "n 3"]:
        """Centres."""
        return torch.cat([self.static.means, self.moving.means])

    @property
    def quaternions(self) -> Float[Tensor, "n 4"]:
        """Rotations, w x y z."""
        return torch.cat([self.static.quaternions, self.moving.quaternions])

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations."""
        return torch.cat([self.static.scales, self.moving.scales])

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """0...1."""
        return torch.cat([self.static.opacities, self.moving.opacities])

    @property
    def velocities(self) -> Float[Tensor, "n 3"]:
        """Of the means, in world units per duration of the capture."""
        return torch.cat([torch.zeros_like(self.static.means), self.moving.velocities])

    def colours(self, seen_from: Float[Tensor, "v 3"]) -> Float[Tensor, "v n c"]:
        """Stored values, see `Gaussians.colours`."""
        return torch.cat([part.colours(seen_from) for part in (self.static, self.moving)], 1)


def quaternion_of(rotation: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions w x y z of rotation vectors; smooth also at zero."""
    half = rotation / 2
    angle = half.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    return torch.cat([angle.cos(), angle.sin() / angle * half], -1)


def quaternion_product(
    left: Float[Tensor, "n 4"], right: Float[Tensor, "n 4"]
) -> Float[Tensor, "n 4"]:
    """The Hamilton product of quaternions w x y z: first the right rotation, then the left."""
    w, x, y, z = left.unbind(-1)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    matrix = torch.stack([torch.stack(row, -1) for row in rows], -2)  # [n, 4, 4]
    return torch.einsum("nij,nj->ni", matrix, right)
