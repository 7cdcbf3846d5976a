"""Run a head over points along rays and composite what it finds, in chunks that fit the cache.

The heads' activations are the bulk of a training step's memory. They are recomputed in the
backward pass, chunk by chunk, so that a step keeps only what was looked up. A chunk fits the
processor's cache, which on a CPU makes this faster than keeping them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sharpfield.core.protocols import Head
from sharpfield.core.struct import Struct
from sharpfield.ops import composite, stepfun

UNSEEN = 1e-4
"""In evaluation, colour is left out where a sample's share of the light is below this."""

CHUNK = {"cpu": 1 << 12, "cuda": 1 << 19}
"""Samples whose head runs at once."""


@dataclass(frozen=True)
class Work(Struct):
    """Points along rays, and how they are to be composited."""

    trailing: ClassVar = {"looked": 2, "points": 2, "z": 1, "noise": 1, "order": 1, "direction": 1}

    looked: Float[Tensor, "*b s f"]
    points: Float[Tensor, "*b s 3"]
    z: Float[Tensor, "*b s"]
    """Ray parameter, ascending."""
    length: Float[Tensor, "*b"]
    """Length of the ray's direction in the renderer's space."""
    direction: Float[Tensor, "*b 3"]
    """Unit viewing direction in the world."""
    order: Int64[Tensor, "*b s"] | None = None
    """Points are in this order of z; None if they ascend. Only what heads return is permuted."""
    noise: Float[Tensor, "*b s"] | None = None
    """Added to raw density."""


@dataclass(frozen=True)
class Found(Struct):
    """What compositing gives for each ray."""

    trailing: ClassVar = {"rgb": 1, "weights": 1, "feature": 2}

    rgb: Float[Tensor, "*b c"]
    depth: Float[Tensor, "*b"]
    opacity: Float[Tensor, "*b"]
    weights: Float[Tensor, "*b s"]
    feature: Float[Tensor, "*b s h"] | None = None
    """Hidden features of the head at the points in ascending order, if asked for."""


@dataclass(frozen=True)
class Compositing:
    """How density becomes light."""

    activation: Callable[[Tensor], Tensor] = torch.relu
    """From raw density to density."""
    opaque_end: bool = True
    """The last point stops all light: there is nothing behind."""
    background: float = 0.0
    """Light from behind where the end is not opaque."""
    clear_before: float = 0.0
    """Nothing is seen up to this ray parameter."""


def gather(head: Head, work: Work, how: Compositing, *, keep_feature: bool = False) -> Found:
    """Density and colour of all points, composited along each ray.

    Args:
        head: Density and colour from what was looked up.
        work: Rays with their points, on one leading axis.
        how: Activation and ends.
        keep_feature: Also return the head's hidden features.
    """
    step = max(CHUNK[work.z.device.type] // work.z.shape[1], 1)
    pieces = [work[first : first + step] for first in range(0, max(len(work), 1), step)]
    if not torch.is_grad_enabled():
        return Found.cat([_seen(head, piece, how, keep_feature=keep_feature) for piece in pieces])

    def run(looked: Tensor, piece: Work) -> tuple[Tensor | None, ...]:
        found = _all(head, looked, piece, how, keep_feature=keep_feature)
        return found.rgb, found.depth, found.opacity, found.weights, found.feature

    # What is looked up is passed as a tensor of its own, so that gradients reach it; split at once,
    # because the gradient of a slice is a tensor of zeros as large as the whole.
    parts = [
        Found(*checkpoint(run, looked, piece, use_reentrant=False, preserve_rng_state=False))
        for looked, piece in zip(work.looked.split(step), pieces, strict=True)
    ]
    return Found.cat(parts)


def _weights(raw: Float[Tensor, "b s"], work: Work, how: Compositing) -> Float[Tensor, "b s"]:
    if work.order is not None:
        raw = raw.gather(-1, work.order)
    if work.noise is not None:
        raw = raw + work.noise
    density = how.activation(raw)
    if how.clear_before > 0:
        following = torch.cat([work.z[..., 1:], work.z[..., -1:]], -1)
        density = density * (following > how.clear_before)
    delta = composite.gaps(work.z, work.length)
    return composite.weigh(density, delta, opaque_end=how.opaque_end)


def _all(
    head: Head, looked: Float[Tensor, "b s f"], work: Work, how: Compositing, *, keep_feature: bool
) -> Found:
    """With the colour of every point: for training."""
    raw, hidden = head.density(looked, work.points)
    colour = head.colour(hidden, work.direction)
    weights = _weights(raw, work, how)
    rgb = composite.gather(_as_they_come(weights, work), colour)
    return _found(rgb, weights, work, how, hidden, keep_feature)


def _seen(head: Head, work: Work, how: Compositing, *, keep_feature: bool) -> Found:
    """With the colour of those points only that send any light to speak of: for evaluation."""
    raw, hidden = head.density(work.looked, work.points)
    weights = _weights(raw, work, how)
    share = _as_they_come(weights, work)
    keep = share > UNSEEN
    ray = keep.nonzero()[:, 0]
    colour = head.colour(hidden[keep][:, None], work.direction[ray])[:, 0]
    rgb = composite.gather_kept(share, keep, colour)
    return _found(rgb, weights, work, how, hidden, keep_feature)


def _as_they_come(weights: Float[Tensor, "b s"], work: Work) -> Float[Tensor, "b s"]:
    """Weights of sorted points in the order that the points have: cheaper than sorting colours."""
    if work.order is None:
        return weights
    return torch.zeros_like(weights).scatter(-1, work.order, weights)


def _found(
    rgb: Tensor, weights: Tensor, work: Work, how: Compositing, hidden: Tensor, keep_feature: bool
) -> Found:
    if keep_feature and work.order is not None:
        hidden = stepfun.take_along(hidden, work.order)
    opacity = weights.sum(-1)
    if not how.opaque_end:
        rgb = rgb + how.background * (1 - opacity)[..., None]
    return Found(
        rgb, (weights * work.z).sum(-1), opacity, weights, hidden.float() if keep_feature else None
    )
