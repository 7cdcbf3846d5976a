"""Run a head over points along rays and composite what it finds, in chunks that fit the cache.

The heads' activations are the bulk of a training step's memory. They are recomputed in the
backward pass, chunk by chunk, so that a step keeps only what was looked up. A chunk fits the
CPU's cache, which on a CPU makes this faster than keeping them.

Most points are empty or hidden. What sends no light has no colour to speak of, and nothing to
learn: such points are asked for their density alone, and only those that are left take part in the
backward pass.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sharpfield.core.protocols import Head
from sharpfield.core.struct import Struct
from sharpfield.ops import compositing, stepfun

UNSEEN = 1e-4
"""In evaluation, colour is left out where a sample's share of the light is below this."""

SPECK = 1e-7
"""The same in training, where it must not show in any gradient: a rounding error of float32."""

ROUND = 256
"""Points are left out in such steps, see `_marked`."""

CHUNK = {"cpu": 1 << 12, "cuda": 1 << 19}
"""Samples whose head runs at once."""


@dataclass(frozen=True)
class Work(Struct):
    """Points along rays, and how they are to be composited."""

    trailing: ClassVar = {"looked": 2, "points": 2} | dict.fromkeys(
        ("z", "noise", "order", "direction"), 1
    )

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
    """Features of the head at the points in ascending order, if asked for."""


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


@dataclass(frozen=True)
class Known:
    """Which points are still to be asked, and the raw density of all others."""

    asked: Int64[Tensor, " n"]
    """Counted along one ray after the other."""
    raw: Float[Tensor, "b s"]


def composite_head(
    head: Head, work: Work, how: Compositing, *, keep_feature: bool = False
) -> Found:
    """Density and colour of all points, composited along each ray.

    Args:
        head: Density and colour from what was looked up.
        work: Rays with their points, on one leading axis.
        how: Activation and ends.
        keep_feature: Also return the head's features.
    """
    step = max(CHUNK[work.z.device.type] // work.z.shape[1], 1)
    pieces = [work[first : first + step] for first in range(0, max(len(work), 1), step)]
    run = _run_with_features if keep_feature else _run
    if not torch.is_grad_enabled():
        return Found.cat([run(head, piece, how, None, UNSEEN) for piece in pieces])

    def learn(looked: Tensor, piece: Work, known: Known | None) -> tuple[Tensor | None, ...]:
        found = run(head, replace(piece, looked=looked), how, known, SPECK)
        return found.rgb, found.depth, found.opacity, found.weights, found.feature

    # What is looked up is passed as a tensor of its own, so that gradients reach it; split at once,
    # because the gradient of a slice is a tensor of zeros as large as the whole.
    parts: list[Found] = []
    for looked, piece in zip(work.looked.split(step), pieces, strict=True):
        known = None if keep_feature else _first_look(head, piece, how)
        inputs = (looked, piece, known)
        parts.append(
            Found(*checkpoint(learn, *inputs, use_reentrant=False, preserve_rng_state=False))
        )
    return Found.cat(parts)


@torch.no_grad()
def _first_look(head: Head, work: Work, how: Compositing) -> Known:
    """The points that have something to learn, and the density of the rest."""
    raw, _ = head.density(work.looked, work.points)
    share = _as_they_come(_weights(raw, work, how), work)
    return Known(_marked(share > SPECK), raw)


def _marked(points: Bool[Tensor, "*b"]) -> Int64[Tensor, " n"]:
    """Numbers of the points that are marked, and of a few more.

    Their count is rounded up, because each new shape of a product is prepared anew: that costs
    more than a few points, and is kept in memory.
    """
    count = -(-int(points.sum()) // ROUND) * ROUND
    return points.flatten().byte().argsort(descending=True, stable=True)[:count]


def _run(head: Head, work: Work, how: Compositing, known: Known | None, faint: float) -> Found:
    """With features and colour of those points only that send more light than is faint."""
    looked, points = work.looked.flatten(0, 1), work.points.flatten(0, 1)
    if known is not None:
        looked = looked.index_select(0, known.asked)
        points = points.index_select(0, known.asked)
    raw, hidden = head.density(looked, points)
    if known is not None:
        raw = known.raw.flatten().index_copy(0, known.asked, raw)
    raw = raw.view(work.z.shape)
    weights = _weights(raw, work, how)
    share = _clear(_as_they_come(weights, work), faint)
    seen = (share > 0).flatten()
    kept = _marked(seen if known is None else seen[known.asked])
    feature = head.feature(hidden.index_select(0, kept))
    rgb = _mixed(head, work, feature, share, kept if known is None else known.asked[kept])
    return _found(rgb, weights, work, how)


def _run_with_features(
    head: Head, work: Work, how: Compositing, known: Known | None, faint: float
) -> Found:
    """With the features of every point."""
    assert known is None, "features are wanted of all points"
    raw, hidden = head.density(work.looked, work.points)
    feature = head.feature(hidden)
    weights = _weights(raw, work, how)
    share = _clear(_as_they_come(weights, work), faint)
    kept = _marked(share > 0)
    rgb = _mixed(head, work, feature.flatten(0, 1).index_select(0, kept), share, kept)
    if work.order is not None:
        feature = stepfun.take_along(feature, work.order)
    return replace(_found(rgb, weights, work, how), feature=feature)


def _weights(raw: Float[Tensor, "b s"], work: Work, how: Compositing) -> Float[Tensor, "b s"]:
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


def _as_they_come(weights: Float[Tensor, "b s"], work: Work) -> Float[Tensor, "b s"]:
    """Weights of sorted points in the order that the points have: cheaper than sorting colours."""
    if work.order is None:
        return weights
    return torch.zeros_like(weights).scatter(-1, work.order, weights)


def _clear(share: Float[Tensor, "b s"], faint: float) -> Float[Tensor, "b s"]:
    """Without what is faint, whether or not its colour is worked out: see `_marked`."""
    return share * (share > faint)


def _mixed(
    head: Head,
    work: Work,
    feature: Float[Tensor, "n f"],
    share: Float[Tensor, "b s"],
    kept: Int64[Tensor, " n"],
) -> Float[Tensor, "b c"]:
    """Light of each ray from the points that are kept; `feature` is theirs."""
    direction = work.direction[kept // work.z.shape[1]]
    colour = head.colour(feature[:, None], direction)[:, 0]
    return compositing.gather_kept(share, kept, colour)


def _found(rgb: Tensor, weights: Tensor, work: Work, how: Compositing) -> Found:
    opacity = weights.sum(-1)
    if not how.opaque_end:
        rgb = rgb + how.background * (1 - opacity)[..., None]
    return Found(rgb, (weights * work.z).sum(-1), opacity, weights)
