"""The image formation formula: a measurement is a weighted sum of the sharp light along a few rays.

    observed = outer( sum_k  w_k inner( L_k ) )

`L_k` is the linear light along ray k and `w_k` the weight stored with that ray. A sensor is then a
choice of rays and weights (*expose*) and two curves: `inner` is applied to the light of each ray,
`outer` to their sum.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.rays import Radiance
from sharpfield.core.tone import Curve, identity


def mix(
    radiance: Radiance, inner: Curve = identity, outer: Curve = identity
) -> Float[Tensor, "*b c"]:
    """The measurement of a sensor, from the light along its rays.

    Args:
        radiance: Light of the rays `[*b, k]` that make each measurement, with their weights.
        inner: Applied to the light of each ray.
        outer: Applied to the weighted sum.
    """
    weight = radiance.weight[..., None]  # [*b, k, 1]
    return outer((weight * inner(radiance.rgb)).sum(-2))


def mix_with_few_gradients(few: Radiance, rest: Radiance) -> Float[Tensor, "*b c"]:
    """The mean light of many rays, with the gradient of the mean of a few of them only.

    Args:
        few: Rays with gradients `[*b, k]`, whose weights add up to 1.
        rest: The others `[*b, r]`, rendered without gradients, with their weights in the whole
            mean.
    """
    mean = mix(few)
    with torch.no_grad():
        weight = 1 - rest.weight.sum(-1)[..., None]
        missing = mix(rest) + weight * mean - mean
    return mean + missing
