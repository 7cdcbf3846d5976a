"""Gaussians that come, move and go: each lives around a moment of its own.

At its *moment* a Gaussian is where its mean says and as opaque as it gets. Before and after, it has
moved along a polynomial of the third degree and turned at an even pace. It stays as opaque for most
of its *span* and then fades fast, as exp(-d^4/2), d the time since its moment in spans. What stays
in sight for longer is handed from one to the next, so that no motion is too long or too intricate
to be followed.

Source: Li et al., "Spacetime Gaussian feature splatting" (CVPR 2024), with colours that are stored
instead of features, and without their slow fading as exp(-d^2/2), in which several Gaussians of
different moments lie over each other and blur what they show.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sharpfield.fields.gaussians.static import Gaussians

FADED = 1.9
"""Spans after which a Gaussian has faded to nearly nothing and is not drawn."""


class MovingGaussians(Gaussians):
    """Gaussians around moments. They look the same from everywhere.

    Args:
        base: As they are at their moments; of degree 0.
        moments: 0...1 of the capture.
        span: First span of all, as a part of the capture.
    """

    def __init__(self, base: Gaussians, moments: Float[Tensor, "n"], *, span: float) -> None:
        harmonics = base.harmonics.detach()
        super().__init__(
            base.means.detach(),
            base.quaternions.detach(),
            base.log_scales.detach(),
            base.opacity_logits.detach(),
            harmonics,
        )
        still = torch.zeros_like(self.means)
        self.moments = nn.Parameter(moments.float().clone())
        self.log_spans = nn.Parameter(torch.full_like(self.moments, math.log(span)))
        self.velocities = nn.Parameter(still.clone())
        self.accelerations = nn.Parameter(still.clone())
        self.jerks = nn.Parameter(still.clone())
        """How fast accelerations change."""
        self.turns = nn.Parameter(still.clone())
        """Rotation vectors, for the time of the whole capture."""

    @property
    def spans(self) -> Float[Tensor, "n"]:
        """How long each lasts, as a part of the capture."""
        return self.log_spans.exp()

    def at(self, time: float | Float[Tensor, ""]) -> "Passing":
        """Those that are there at a time, 0...1 of the capture."""
        since = time - self.moments
        age = since / self.spans
        there = age.detach().abs() < FADED
        since, age = since[there, None], age[there]
        bend = self.accelerations[there] / 2 + since * self.jerks[there] / 6
        path = self.velocities[there] + since * bend
        turned = product(half_turn(self.turns[there] * since), self.quaternions[there])
        return GaussiansAtTime(
            means=self.means[there] + since * path,
            quaternions=turned,
            scales=self.scales[there],
            opacities=self.opacities[there] * torch.exp(-0.5 * age**4),
            gaussians=self,
            there=there,
        )


@dataclass(frozen=True)
class GaussiansAtTime:
    """Moving Gaussians at one time."""

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, "n"]
    gaussians: MovingGaussians
    there: Bool[Tensor, "m"]
    """Which of all moving ones these are."""

    def colours(self, seen_from: Float[Tensor, "v 3"]) -> Float[Tensor, "v n c"]:
        """Stored values sent to some places."""
        return self.gaussians.colours(seen_from)[:, self.there]


@dataclass(frozen=True)
class GaussianUnion:
    """Gaussians that stand still, and moving ones at one time."""

    still: Gaussians
    passing: GaussiansAtTime

    @property
    def means(self) -> Float[Tensor, "n 3"]:
        """Centres."""
        return torch.cat([self.still.means, self.passing.means])

    @property
    def quaternions(self) -> Float[Tensor, "n 4"]:
        """Rotations, w x y z."""
        return torch.cat([self.still.quaternions, self.passing.quaternions])

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations."""
        return torch.cat([self.still.scales, self.passing.scales])

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """0...1."""
        return torch.cat([self.still.opacities, self.passing.opacities])

    def colours(self, seen_from: Float[Tensor, "v 3"]) -> Float[Tensor, "v n c"]:
        """Stored values sent to some places."""
        return torch.cat([part.colours(seen_from) for part in (self.still, self.passing)], 1)


def half_turn(turn: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions w x y z of rotation vectors."""
    half = turn / 2
    angle = half.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    return torch.cat([angle.cos(), angle.sin() / angle * half], -1)


def product(left: Float[Tensor, "n 4"], right: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """The Hamilton product of quaternions w x y z: first the right rotation, then the left."""
    w, x, y, z = left.unbind(-1)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    matrix = torch.stack([torch.stack(row, -1) for row in rows], -2)
    return torch.einsum("nij,nj->ni", matrix, right)
