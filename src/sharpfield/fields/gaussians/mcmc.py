"""Gaussians as samples of a distribution: those of no use move to where the others are.

*Relocation*: dead (transparent) Gaussians move to where live ones are, drawn by opacity, and all
Gaussians at one point get the opacity and scales with which they look as the one did before. More
are added in the same way until a maximum is reached. Between relocations, noise moves transparent
Gaussians, and a penalty on opacity and scale frees those of little use. All of it depends on the
Gaussians as they are and on the generator that is passed in.

Source: Kheradmand et al., "3D Gaussian splatting as Markov chain Monte Carlo" (NeurIPS 2024). It
moves the dead and adds new ones in two draws; here both kinds of seats are drawn for at once, so
that the correction counts all who share a place.
"""

import torch
from jaxtyping import Float, Int64
from torch import Generator, Tensor

from sharpfield.core.points import Growth
from sharpfield.fields.gaussians.static import Gaussians

DEAD = 0.005
"""Opacity up to which a Gaussian is of no use."""

MOST_SHARES = 51
"""The published correction is worked out for so many Gaussians at one place."""

MOST_OPAQUE = 1 - 1e-6

NOISE = 5e5
"""Of the Markov chain, times the rate of the means."""

GATE = 100.0
"""How sharply the noise sets in where the opacity falls to `DEAD`."""


def relocate_and_add(
    log_scales: Float[Tensor, "n 3"],
    opacity_logits: Float[Tensor, "n"],
    *,
    budget: int,
    generator: Generator,
    more: float = 0.05,
) -> Growth | None:
    """Move dead Gaussians onto live ones, and add some, so that the image stays the same.

    Live ones are chosen by chance, in proportion to their opacity.

    Args:
        log_scales: Natural log of the standard deviations.
        opacity_logits: Log odds of the opacity.
        budget: Most Gaussians there may be.
        generator: On the device of the Gaussians.
        more: How many are added, as a fraction of those there are.

    Returns:
        None if nothing moves, or all are dead. Its values are named as in `Gaussians`.
    """
    count, device = len(opacity_logits), opacity_logits.device
    opacity = opacity_logits.detach().double().sigmoid()
    dead, live = torch.nonzero(opacity <= DEAD)[:, 0], torch.nonzero(opacity > DEAD)[:, 0]
    added = max(min(int((1 + more) * count), budget) - count, 0)
    camera_streams = torch.cat([dead, torch.arange(count, count + added, device=device)])
    if not len(camera_streams) or not len(live):
        return None
    chosen = live[_drawn(opacity[live], len(camera_streams), generator)]
    place, sharing = chosen.unique(return_counts=True)
    new_opacity, factor = shared(opacity[place], sharing + 1)
    logits, scales = opacity_logits.detach().clone(), log_scales.detach().clone()
    logits[place] = new_opacity.logit().to(logits)
    scales[place] += factor.log().to(scales)[:, None]
    source = torch.arange(count + added, device=device)
    source[camera_streams] = chosen
    fresh = torch.zeros_like(source, dtype=torch.bool)
    fresh[camera_streams] = True
    return Growth(source, fresh, {"opacity_logits": logits[source], "log_scales": scales[source]})


def shared(
    opacity: Float[Tensor, "n"], sharing: Int64[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Opacity of N equal Gaussians that look like a single one, and the factor on its scales.

    They stop as much light as it did at the centre, and as much along any line through it (eq. 9).

    Args:
        opacity: Of the one, float64 because the sums cancel.
        sharing: N; what is beyond `MOST_SHARES` is not corrected for.
    """
    shares = sharing.clamp(1, MOST_SHARES).double()
    new = 1 - (1 - opacity.clamp_max(MOST_OPAQUE)) ** (1 / shares)
    new = new.clamp_min(DEAD)
    k = torch.arange(1, MOST_SHARES + 1, device=opacity.device, dtype=torch.float64)
    # The paper sums C(i - 1, k) over i = 1...N, which is C(N, k + 1).
    n = shares[:, None]
    log_choose = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma((n - k).clamp_min(0) + 1)
    choose = torch.where(k <= n, log_choose.exp(), 0.0)
    sign = 2 * (k % 2) - 1
    stopped = (choose * sign * new[:, None] ** k / k.sqrt()).sum(-1)
    return new, opacity / stopped


def position_noise(
    gaussians: Gaussians, rate: float, generator: Generator, *, noise: float = NOISE
) -> Float[Tensor, "n 3"]:
    """Noise to add to the means after a step: as far as a Gaussian reaches, if it is transparent.

    Args:
        gaussians: As they are.
        rate: Learning rate of the means at this step, in world units.
        generator: On the device of the Gaussians.
        noise: Strength relative to the rate.
    """
    with torch.no_grad():
        means = gaussians.means
        gate = torch.sigmoid(GATE * (DEAD - gaussians.opacities))
        normal = torch.randn(means.shape, generator=generator, device=means.device)
        axes = gaussians.rotations * gaussians.scales[:, None]  # of the ellipsoids, as columns
        along = (axes @ (axes.mT @ normal[..., None]))[..., 0]  # covariance times noise
        return rate * noise * gate[:, None] * along


def opacity_scale_penalty(gaussians: Gaussians) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean opacity and mean scale. As losses (published: 0.01 of each) they free useless ones."""
    return gaussians.opacities.mean(), gaussians.scales.mean()


def _drawn(weight: Float[Tensor, "n"], count: int, generator: Generator) -> Int64[Tensor, "m"]:
    """Rows drawn with replacement in proportion to their weight; `multinomial` takes 2^24 rows."""
    edges = weight.cumsum(0)
    chance = torch.rand(count, generator=generator, device=weight.device, dtype=weight.dtype)
    return torch.searchsorted(edges, chance * edges[-1], right=True).clamp_max(len(weight) - 1)
