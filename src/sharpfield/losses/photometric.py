"""How far predicted images are from measured ones.

A term that makes points decide whether they are on a surface.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.frames import LEAST_DEPTH


def mse(predicted: Float[Tensor, "*b c"], measured: Float[Tensor, "*b c"]) -> Float[Tensor, ""]:
    """Mean squared difference over pixels and channels.

    Serves blurred pixels and the prior from the event double integral alike.

    Args:
        predicted: In the encoding of `measured`.
        measured: As stored, usually 0...1; a prior may exceed 1.
    """
    return (predicted - measured).square().mean()


NEARLY = 1e-3
"""Confidences this close to 0 or 1 are let alone."""


def indecision(confidence: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of log c + log(1 - c): highest at one half, so that its descent leads to 0 or 1.

    Args:
        confidence: 0...1.

    Source: Point-NeRF (CVPR 2022), section 4.2, there with weight 1e-4.
    """
    if not len(confidence):
        return confidence.sum()
    bounded = confidence.clamp(NEARLY, 1 - NEARLY)
    return torch.mean(bounded.log() + (1 - bounded).log())


def depth_error(drawn: Float[Tensor, "*b"], measured: Float[Tensor, "*b"]) -> Float[Tensor, ""]:
    """Mean of how far drawn depth is off, as a part of what was measured; 0 is unknown."""
    known = measured > 0
    off = (drawn - measured).abs() / measured.clamp_min(LEAST_DEPTH)
    # Beyond its own size an error says no more: one of the two sees past an edge.
    return torch.where(known, off.clamp_max(1), 0).sum() / known.sum().clamp_min(1)
