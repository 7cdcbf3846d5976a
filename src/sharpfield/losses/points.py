"""A term that makes points decide whether they are on a surface."""

import torch
from jaxtyping import Float
from torch import Tensor

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
