"""Hierarchical volume rendering: coarse samples, then fine samples by importance.

Source: NeRF (ECCV 2020), section 5.2; the released code of Ev-DeblurNeRF for the details of
sampling and compositing.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from sharpfield.core.protocols import Field
from sharpfield.core.rays import Radiance, Rays, Samples
from sharpfield.geometry.space import Space
from sharpfield.ops import stepfun
from sharpfield.rendering.head_compositing import Compositing, RayPoints, composite_head


@dataclass(frozen=True)
class CoarseToFine:
    """Volume rendering with importance sampling.

    With a generator, as in training, points are jittered and noise is added to densities; without
    one the result depends on the rays only.
    """

    field: Field
    space: Space
    samples: tuple[int, int] = (64, 64)
    """Coarse points on a ray, and the fine ones added to them."""
    noise: float = 1.0
    """Standard deviation of the noise on raw density in training."""
    how: Compositing = Compositing()

    def __call__(
        self, rays: Rays, generator: Generator | None = None, *, samples: bool = False
    ) -> Radiance:
        """Radiance of rays of any shape; with `samples`, also the features along them."""
        found = self._both(rays.reshape(-1), generator, samples=samples)
        return found.reshape(*rays.shape)

    def _both(self, rays: Rays, generator: Generator | None, *, samples: bool) -> Radiance:
        origin, direction = self.space.warp(rays)
        length = direction.norm(dim=-1)

        def at(z: Float[Tensor, "b s"]) -> Float[Tensor, "b s 3"]:
            return origin[:, None] + z[..., None] * direction[:, None]

        z = self._coarse_depths(rays, generator)
        features = self.field.coarse_features(at(z), rays.time)
        work = RayPoints(
            features, at(z), z, length, rays.direction, noise=self._noise(z.shape, generator, rays)
        )
        coarse = composite_head(self.field.coarse, work, self.how)

        more = stepfun.resample_points(z, coarse.weights.detach(), self._positions(rays, generator))
        both, order = stepfun.merge(z, more)
        work = RayPoints(
            self.field.fine_features(features, at(z), at(more), rays.time),
            torch.cat([at(z), at(more)], -2),
            both,
            length,
            rays.direction,
            order=order,
            noise=self._noise(both.shape, generator, rays),
        )
        fine = composite_head(self.field.fine, work, self.how, keep_feature=samples)
        return Radiance(
            fine.rgb,
            fine.depth,
            fine.opacity,
            rays.weight,
            coarse=Radiance(coarse.rgb, coarse.depth, coarse.opacity, rays.weight),
            samples=None if fine.feature is None else Samples(both, fine.feature, direction),
        )

    def _coarse_depths(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "b s"]:
        even = torch.linspace(self.space.near, self.space.far, self.samples[0], device=rays.device)
        z = even.expand(len(rays), -1)
        if generator is None:
            return z
        return stepfun.jitter(z, stepfun.random_positions(rays.shape, z.shape[1], generator))

    def _positions(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "b m"]:
        if generator is None:
            return stepfun.even_positions(rays.shape, self.samples[1], rays.device)
        return stepfun.random_positions(rays.shape, self.samples[1], generator)

    def _noise(
        self, shape: torch.Size, generator: Generator | None, rays: Rays
    ) -> Float[Tensor, "b s"] | None:
        if generator is None or self.noise == 0:
            return None
        return self.noise * torch.randn(shape, generator=generator, device=rays.device)
