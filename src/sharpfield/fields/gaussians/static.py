"""3D Gaussians: ellipsoids with a mean, a rotation, scales, an opacity and a colour.

All parameters are unbounded: quaternions (w x y z) of any length, the natural log of scales, the
logit of opacities, and real spherical harmonics (SH) of the colour. The *base* harmonics are those
of SH degree 0, the same in all directions; the *higher* ones tell how the colour changes with the
direction, and usually learn more slowly. A colour is 0.5 + the sum of its harmonics, and never
below zero; whether it means light or what frames store is up to the renderer.

Source: Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering" (SIGGRAPH
2023). Its harmonics carry the Condon-Shortley phase and ours do not, see `ops/encoding.py`.
"""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.geometry.se3 import rotation_from_quaternion
from sharpfield.ops.encoding import spherical_harmonics

FLAT = 0.28209479177387814
"""The spherical harmonic of degree 0, the same in all directions."""

GREY = 0.5
"""Colour of a Gaussian whose harmonics are all zero."""


class Gaussians(nn.Module):
    """Static Gaussians; every parameter has one row for each.

    Args:
        means: In world units.
        quaternions: w x y z, of any length but zero.
        log_scales: Natural log of the three standard deviations, in world units.
        opacity_logits: Log odds of the opacity.
        harmonics: k = (SH degree + 1)^2 for each of c = 1 or 3 colours.
    """

    def __init__(
        self,
        means: Float[Tensor, "n 3"],
        quaternions: Float[Tensor, "n 4"],
        log_scales: Float[Tensor, "n 3"],
        opacity_logits: Float[Tensor, "n"],
        harmonics: Float[Tensor, "n k c"],
    ) -> None:
        super().__init__()
        self.sh_degree = math.isqrt(harmonics.shape[1]) - 1
        if (self.sh_degree + 1) ** 2 != harmonics.shape[1]:
            raise ValueError(f"Gaussians: no SH degree has {harmonics.shape[1]} harmonics")
        self.means = nn.Parameter(means)
        self.quaternions = nn.Parameter(quaternions)
        self.log_scales = nn.Parameter(log_scales)
        self.opacity_logits = nn.Parameter(opacity_logits)
        self.base_harmonics = nn.Parameter(harmonics[:, :1].clone())
        self.higher_harmonics = nn.Parameter(harmonics[:, 1:].clone())

    @classmethod
    def start(
        cls,
        points: Float[Tensor, "n 3"],
        colours: Float[Tensor, "n c"],
        sizes: Float[Tensor, "n"],
        *,
        sh_degree: int = 0,
        opacity: float = 0.1,
    ) -> "Gaussians":
        """Spheres of the same colour in all directions.

        Args:
            points: Their means.
            colours: Not below zero.
            sizes: Standard deviations in world units.
            sh_degree: Of the spherical harmonics they can learn, 0 to 3.
            opacity: Of each, between 0 and 1.
        """
        count, channels = colours.shape
        harmonics = torch.zeros(count, (sh_degree + 1) ** 2, channels, device=points.device)
        harmonics[:, 0] = (colours - GREY) / FLAT
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0], device=points.device)
        logit = math.log(opacity / (1 - opacity))
        return cls(
            points.float().clone(),
            upright.repeat(count, 1),
            sizes.float().log()[:, None].repeat(1, 3),
            torch.full((count,), logit, device=points.device),
            harmonics,
        )

    def __len__(self) -> int:
        """How many there are."""
        return len(self.means)

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along their own axes, in world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """0...1, at their centres."""
        return self.opacity_logits.sigmoid()

    @property
    def rotations(self) -> Float[Tensor, "n 3 3"]:
        """World-from-own-axes."""
        return rotation_from_quaternion(self.quaternions)

    @property
    def harmonics(self) -> Float[Tensor, "n k c"]:
        """Base and higher ones together."""
        return torch.cat([self.base_harmonics, self.higher_harmonics], 1)

    def colours(
        self, seen_from: Float[Tensor, "v 3"], *, sh_degree: int | None = None
    ) -> Float[Tensor, "v n c"]:
        """The colour of each Gaussian as seen from v camera centres.

        Args:
            seen_from: Camera centres in world axes.
            sh_degree: Leaves out harmonics above it; by default none.
        """
        degree = self.sh_degree if sh_degree is None else min(sh_degree, self.sh_degree)
        light = (GREY + FLAT * self.base_harmonics[:, 0])[None]  # [1, n, c]
        if degree == 0:
            return light.clamp_min(0).expand(len(seen_from), -1, -1)
        toward = self.means - seen_from[:, None]
        basis = spherical_harmonics(nn.functional.normalize(toward, dim=-1), degree)[..., 1:]
        learned = self.higher_harmonics[:, : basis.shape[-1]]
        return (light + torch.einsum("vnk,nkc->vnc", basis, learned)).clamp_min(0)

    def joined(self, other: "Gaussians") -> "Gaussians":
        """These and others of the same SH degree together."""
        names = ("means", "quaternions", "log_scales", "opacity_logits", "harmonics")
        rows = [
            torch.cat([getattr(part, name).detach() for part in (self, other)]) for name in names
        ]
        return Gaussians(*rows)

    def points(self) -> dict[str, Tensor]:
        """All parameters by name; each has one row for each Gaussian."""
        return dict(self.named_parameters())

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Replace all Gaussians by others, of any number; all parameters are new objects.

        Args:
            points: By the names of `points`, with the same rows.
        """
        for name, values in points.items():
            learns = getattr(self, name).requires_grad
            setattr(self, name, nn.Parameter(values.detach(), requires_grad=learns))
