"""Input encodings of small networks: frequencies (positional encoding) and spherical harmonics.

Sources: NeRF (ECCV 2020), eq. 4, with the coordinate itself kept and without the factor pi;
Sloan, *Efficient Spherical Harmonic Evaluation* (JCGT 2013) for the real basis.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def frequencies(x: Float[Tensor, "*b d"], octaves: int) -> Float[Tensor, "*b f"]:
    """[x, sin x, cos x, sin 2x, cos 2x, ..., sin 2^(L-1) x, cos 2^(L-1) x], f = d (1 + 2 L).

    Args:
        x: Coordinates or directions, about -1 to 1.
        octaves: The number L of frequencies; 0 leaves `x` as it is.
    """
    octave = torch.arange(octaves, dtype=x.dtype, device=x.device).repeat_interleave(2)
    # cos x = sin(x + pi/2): a single call, whose result already has the right order.
    turn = torch.tensor([0, math.pi / 2], dtype=x.dtype, device=x.device).repeat(octaves)
    angle = torch.addcmul(turn[:, None], x[..., None, :], 2.0 ** octave[:, None])
    return torch.cat([x, angle.sin().flatten(-2)], -1)  # angle: [*b, 2 octaves, d]


def frequencies_width(coordinates: int, octaves: int) -> int:
    """Number of features of `frequencies`."""
    return coordinates * (1 + 2 * octaves)


def spherical_harmonics(direction: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b f"]:
    """Real orthonormal spherical harmonics up to and including `degree`, f = (degree + 1)^2.

    Ordered by degree l, then by order m from -l to l. No Condon-Shortley phase: the three of
    degree 1 are proportional to +y, +z, +x.

    Args:
        direction: Unit length.
        degree: 0 to 4.
    """
    if not 0 <= degree <= 4:
        raise ValueError(f"spherical_harmonics: degree must be 0 to 4, not {degree}")
    x, y, z = direction.unbind(-1)
    bands = [[torch.full_like(x, 0.28209479177387814)]]
    if degree >= 1:
        bands.append([0.4886025119029199 * axis for axis in (y, z, x)])
    if degree >= 2:
        bands.append(_second(x, y, z))
    if degree >= 3:
        bands.append(_third(x, y, z))
    if degree >= 4:
        bands.append(_fourth(x, y, z))
    return torch.stack([value for band in bands for value in band], -1)


def _second(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    return [
        1.0925484305920792 * x * y,
        1.0925484305920792 * y * z,
        0.31539156525252005 * (3 * z * z - 1),
        1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]


def _third(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    return [
        0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (5 * z * z - 1),
        0.3731763325901154 * z * (5 * z * z - 3),
        0.4570457994644658 * x * (5 * z * z - 1),
        1.445305721320277 * z * (x * x - y * y),
        0.5900435899266435 * x * (x * x - 3 * y * y),
    ]


def _fourth(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    xx, yy, zz = x * x, y * y, z * z
    return [
        2.5033429417967046 * x * y * (xx - yy),
        1.7701307697799304 * y * z * (3 * xx - yy),
        0.9461746957575601 * x * y * (7 * zz - 1),
        0.6690465435572892 * y * z * (7 * zz - 3),
        0.10578554691520431 * (35 * zz * zz - 30 * zz + 3),
        0.6690465435572892 * x * z * (7 * zz - 3),
        0.47308734787878004 * (xx - yy) * (7 * zz - 1),
        1.7701307697799304 * x * z * (xx - 3 * yy),
        0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
    ]
