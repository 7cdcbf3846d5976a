"""Hierarchical volume rendering: coarse samples, then fine samples by importance.

Heads are evaluated in chunks of points, and their activations, most of a training step's memory,
are recomputed in the backward pass (gradient checkpointing), so that a step keeps only the
looked-up features. A chunk fits the CPU's cache, which on a CPU makes this faster than keeping
them. Most points are empty or occluded: those of negligible weight need no colour and get no
gradient; only their density is computed, and only the others take part in the backward pass.

Source: NeRF (ECCV 2020), section 5.2; the released code of Ev-DeblurNeRF for the details of
sampling and compositing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Generator, Tensor
from torch.utils.checkpoint import checkpoint

from sharpfield.core.protocols import Field, Head
from sharpfield.core.rays import Radiance, Rays, Samples
from sharpfield.core.struct import Struct
from sharpfield.geometry.space import Space
from sharpfield.ops import compositing, stepfun

MIN_WEIGHT_EVAL = 1e-4
"""In evaluation, colour is not computed for samples of a smaller weight."""

MIN_WEIGHT_TRAIN = 1e-7
"""The same in training, where it must not affect any gradient: a rounding error of float32."""

MULTIPLE = 256
"""The number of selected points is rounded up to a multiple of this, see `_selected`."""

CHUNK = {"cpu": 1 << 12, "cuda": 1 << 19}
"""Samples for which the head is evaluated at once."""


@dataclass(frozen=True)
class RayPoints(Struct):
    """Points along rays, with all that their head and compositing need."""

    trailing: ClassVar = {"features": 2, "points": 2} | dict.fromkeys(
        ("z", "noise", "order", "direction"), 1
    )

    features: Float[Tensor, "*b s f"]
    points: Float[Tensor, "*b s 3"]
    z: Float[Tensor, "*b s"]
    """Ray parameter, ascending."""
    length: Float[Tensor, "*b"]
    """Length of the ray's direction in the renderer's space."""
    direction: Float[Tensor, "*b 3"]
    """Unit viewing direction in the world."""
    order: Int64[Tensor, "*b s"] | None = None
    """Sorts the points by z; None if they ascend. Only the outputs of heads are permuted."""
    noise: Float[Tensor, "*b s"] | None = None
    """Added to raw density."""


@dataclass(frozen=True)
class RenderedRays(Struct):
    """The result of compositing for each ray."""

    trailing: ClassVar = {"rgb": 1, "weights": 1, "feature": 2}

    rgb: Float[Tensor, "*b c"]
    depth: Float[Tensor, "*b"]
    opacity: Float[Tensor, "*b"]
    weights: Float[Tensor, "*b s"]
    feature: Float[Tensor, "*b s h"] | None = None
    """Features of the head at the points in ascending order, if requested."""


@dataclass(frozen=True)
class Compositing:
    """Options of compositing."""

    activation: Callable[[Tensor], Tensor] = torch.relu
    """From raw density to density."""
    opaque_end: bool = True
    """The last point absorbs all remaining light: there is nothing behind it."""
    background: float = 0.0
    """Light from behind where the end is not opaque."""
    clear_before: float = 0.0
    """Density up to this ray parameter is ignored."""


@dataclass(frozen=True)
class DensityPass:
    """The points that need gradients, and the raw density of all points."""

    selected: Int64[Tensor, " n"]
    """Flat indices, one ray after the other."""
    raw: Float[Tensor, "b s"]


def composite_head(
    head: Head, work: RayPoints, how: Compositing, *, keep_feature: bool = False
) -> RenderedRays:
    """Density and colour of all points, composited along each ray.

    Args:
        head: Density and colour from features.
        work: Rays with their points, on one leading axis.
        how: Activation and ends.
        keep_feature: Also return the head's features.
    """
    step = max(CHUNK[work.z.device.type] // work.z.shape[1], 1)
    pieces = [work[first : first + step] for first in range(0, max(len(work), 1), step)]
    run = _run_with_features if keep_feature else _run
    if not torch.is_grad_enabled():
        return RenderedRays.cat([run(head, piece, how, None, MIN_WEIGHT_EVAL) for piece in pieces])

    def learn(
        features: Tensor, piece: RayPoints, known: DensityPass | None
    ) -> tuple[Tensor | None, ...]:
        found = run(head, replace(piece, features=features), how, known, MIN_WEIGHT_TRAIN)
        return found.rgb, found.depth, found.opacity, found.weights, found.feature

    # Features are passed as a tensor of their own, so that gradients reach them; split at once,
    # because the gradient of a slice is a tensor of zeros as large as the whole.
    parts: list[RenderedRays] = []
    for features, piece in zip(work.features.split(step), pieces, strict=True):
        known = None if keep_feature else _density_pass(head, piece, how)
        inputs = (features, piece, known)
        parts.append(
            RenderedRays(*checkpoint(learn, *inputs, use_reentrant=False, preserve_rng_state=False))
        )
    return RenderedRays.cat(parts)


@torch.no_grad()
def _density_pass(head: Head, work: RayPoints, how: Compositing) -> DensityPass:
    """Density of all points, without gradients, and the points that need gradients."""
    raw, _ = head.density(work.features, work.points)
    weight = _unsorted(_weights(raw, work, how), work)
    return DensityPass(_selected(weight > MIN_WEIGHT_TRAIN), raw)


def _selected(points: Bool[Tensor, "*b"]) -> Int64[Tensor, " n"]:
    """Flat indices of the points that are true, and of a few more.

    Their number is rounded up to a multiple, because every new shape of a matrix product is
    prepared and cached anew, which costs more than a few points.
    """
    count = -(-int(points.sum()) // MULTIPLE) * MULTIPLE
    return points.flatten().byte().argsort(descending=True, stable=True)[:count]


def _run(
    head: Head, work: RayPoints, how: Compositing, known: DensityPass | None, faint: float
) -> RenderedRays:
    """Render with features and colour only at points of a weight above `faint`."""
    features, points = work.features.flatten(0, 1), work.points.flatten(0, 1)
    if known is not None:
        features = features.index_select(0, known.selected)
        points = points.index_select(0, known.selected)
    raw, hidden = head.density(features, points)
    if known is not None:
        raw = known.raw.flatten().index_copy(0, known.selected, raw)
    raw = raw.view(work.z.shape)
    weights = _weights(raw, work, how)
    weight = _without_faint(_unsorted(weights, work), faint)
    seen = (weight > 0).flatten()
    kept = _selected(seen if known is None else seen[known.selected])
    feature = head.feature(hidden.index_select(0, kept))
    rgb = _colour_of(head, work, feature, weight, kept if known is None else known.selected[kept])
    return _rendered(rgb, weights, work, how)


def _run_with_features(
    head: Head, work: RayPoints, how: Compositing, known: DensityPass | None, faint: float
) -> RenderedRays:
    """Render with the features of every point."""
    assert known is None, "features of all points are requested"
    raw, hidden = head.density(work.features, work.points)
    feature = head.feature(hidden)
    weights = _weights(raw, work, how)
    weight = _without_faint(_unsorted(weights, work), faint)
    kept = _selected(weight > 0)
    rgb = _colour_of(head, work, feature.flatten(0, 1).index_select(0, kept), weight, kept)
    if work.order is not None:
        feature = stepfun.take_along(feature, work.order)
    return replace(_rendered(rgb, weights, work, how), feature=feature)


def _weights(raw: Float[Tensor, "b s"], work: RayPoints, how: Compositing) -> Float[Tensor, "b s"]:
    if work.order is not None:
        raw = raw.gather(-1, work.order)
    if work.noise is not None:
        raw = raw + work.noise
    density = how.activation(raw)
    if how.clear_before > 0:
        following = torch.cat([work.z[..., 1:], work.z[..., -1:]], -1)
        density = density * (following > how.clear_before)
    delta = compositing.gaps(work.z, work.length)
    return compositing.weigh(density, delta, opaque_end=how.opaque_end)


def _unsorted(weights: Float[Tensor, "b s"], work: RayPoints) -> Float[Tensor, "b s"]:
    """Weights of sorted points in the points' original order: cheaper than sorting colours."""
    if work.order is None:
        return weights
    return torch.zeros_like(weights).scatter(-1, work.order, weights)


def _without_faint(weight: Float[Tensor, "b s"], faint: float) -> Float[Tensor, "b s"]:
    """Weights with small ones set to zero, also where their colour is computed, see `_selected`."""
    return weight * (weight > faint)


def _colour_of(
    head: Head,
    work: RayPoints,
    feature: Float[Tensor, "n f"],
    weight: Float[Tensor, "b s"],
    kept: Int64[Tensor, " n"],
) -> Float[Tensor, "b c"]:
    """Light of each ray from the points `kept`, whose features are `feature`."""
    direction = work.direction[kept // work.z.shape[1]]
    colour = head.colour(feature[:, None], direction)[:, 0]
    return compositing.gather_kept(weight, kept, colour)


def _rendered(rgb: Tensor, weights: Tensor, work: RayPoints, how: Compositing) -> RenderedRays:
    opacity = weights.sum(-1)
    if not how.opaque_end:
        rgb = rgb + how.background * (1 - opacity)[..., None]
    return RenderedRays(rgb, (weights * work.z).sum(-1), opacity, weights)


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
