"""MCMC growth: Gaussians as samples of a distribution; dead ones are relocated.

*Relocation*: dead (transparent) Gaussians move to where live ones are, drawn by opacity, and all
copies at one position get the opacity and scales with which together they look as the one did
before. More are added in the same way until `cap_max` is reached. Between relocations, noise moves
transparent Gaussians, and a penalty on opacity and scale frees those of little use. All of it
depends on the Gaussians as they are and on the generator that is passed in.

Source: Kheradmand et al., "3D Gaussian splatting as Markov chain Monte Carlo" (NeurIPS 2024). It
relocates dead Gaussians and adds new ones in two draws; here both are drawn at once, so that the
correction counts all copies at a position.
"""

import torch
from jaxtyping import Float, Int64
from torch import Generator, Tensor

from sharpfield.core.protocols import Growth
from sharpfield.fields.gaussians.static import Gaussians

MIN_OPACITY = 0.005
"""Opacity up to which a Gaussian is dead."""

MAX_COPIES = 51
"""Most copies at one position that the published correction is computed for."""

MAX_OPACITY = 1 - 1e-6

NOISE = 5e5
"""Published strength of the position noise, relative to the learning rate of the means."""

GATE = 100.0
"""How sharply the noise sets in where the opacity falls to `MIN_OPACITY`."""


def relocate_and_add(
    log_scales: Float[Tensor, "n 3"],
    opacity_logits: Float[Tensor, "n"],
    *,
    cap_max: int,
    generator: Generator,
    growth: float = 0.05,
) -> Growth | None:
    """Relocate dead Gaussians onto live ones and add new ones, without changing the image.

    Live ones are chosen at random, with probability proportional to their opacity.

    Args:
        log_scales: Natural log of the standard deviations.
        opacity_logits: Log odds of the opacity.
        cap_max: Maximum number of Gaussians.
        generator: On the device of the Gaussians.
        growth: How many are added, as a fraction of those there are.

    Returns:
        None if nothing moves, or all are dead. Its values are named as in `Gaussians`.
    """
    count, device = len(opacity_logits), opacity_logits.device
    opacity = opacity_logits.detach().double().sigmoid()
    dead = torch.nonzero(opacity <= MIN_OPACITY)[:, 0]
    live = torch.nonzero(opacity > MIN_OPACITY)[:, 0]
    added = max(min(int((1 + growth) * count), cap_max) - count, 0)
    free = torch.cat([dead, torch.arange(count, count + added, device=device)])  # rows to fill
    if not len(free) or not len(live):
        return None
    chosen = live[_sampled(opacity[live], len(free), generator)]
    original, copies = chosen.unique(return_counts=True)
    new_opacity, factor = relocated_opacity_scale(opacity[original], copies + 1)
    logits, scales = opacity_logits.detach().clone(), log_scales.detach().clone()
    logits[original] = new_opacity.logit().to(logits)
    scales[original] += factor.log().to(scales)[:, None]
    source = torch.arange(count + added, device=device)
    source[free] = chosen
    fresh = torch.zeros_like(source, dtype=torch.bool)
    fresh[free] = True
    return Growth(source, fresh, {"opacity_logits": logits[source], "log_scales": scales[source]})


def relocated_opacity_scale(
    opacity: Float[Tensor, "n"], copies: Int64[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Opacity of N equal Gaussians that look like a single one, and the factor on its scales.

    They stop as much light as it did at the centre, and as much along any line through it (eq. 9).

    Args:
        opacity: Of the one, float64 because the sums cancel.
        copies: N; beyond `MAX_COPIES` it is not corrected for.
    """
    n = copies.clamp(1, MAX_COPIES).double()
    new = 1 - (1 - opacity.clamp_max(MAX_OPACITY)) ** (1 / n)
    new = new.clamp_min(MIN_OPACITY)
    k = torch.arange(1, MAX_COPIES + 1, device=opacity.device, dtype=torch.float64)
    # The paper sums C(i - 1, k) over i = 1...N, which is C(N, k + 1).
    n = n[:, None]
    log_choose = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma((n - k).clamp_min(0) + 1)
    choose = torch.where(k <= n, log_choose.exp(), 0.0)  # [n, k]
    sign = 2 * (k % 2) - 1
    stopped = (choose * sign * new[:, None] ** k / k.sqrt()).sum(-1)
    return new, opacity / stopped


def position_noise(
    gaussians: Gaussians, learning_rate: float, generator: Generator, *, noise: float = NOISE
) -> Float[Tensor, "n 3"]:
    """Noise to add to the means after a step: as far as a Gaussian reaches, if it is transparent.

    Args:
        gaussians: As they are.
        learning_rate: Of the means at this step, in world units.
        generator: On the device of the Gaussians.
        noise: Strength relative to the learning rate.
    """
    with torch.no_grad():
        means = gaussians.means
        gate = torch.sigmoid(GATE * (MIN_OPACITY - gaussians.opacities))
        normal = torch.randn(means.shape, generator=generator, device=means.device)
        axes = gaussians.rotations * gaussians.scales[:, None]  # of the ellipsoids, as columns
        along = (axes @ (axes.mT @ normal[..., None]))[..., 0]  # covariance times noise
        return learning_rate * noise * gate[:, None] * along


def opacity_scale_penalty(gaussians: Gaussians) -> Float[Tensor, ""]:
    """Mean opacity plus mean scale; as a loss (published weight 0.01) frees useless Gaussians."""
    return torch.stack([gaussians.opacities.mean(), gaussians.scales.mean()]).sum()


def _sampled(weight: Float[Tensor, "n"], count: int, generator: Generator) -> Int64[Tensor, "m"]:
    """Rows drawn with replacement in proportion to their weight; `multinomial` takes 2^24 rows."""
    edges = weight.cumsum(0)
    chance = torch.rand(count, generator=generator, device=weight.device, dtype=weight.dtype)
    return torch.searchsorted(edges, chance * edges[-1], right=True).clamp_max(len(weight) - 1)
