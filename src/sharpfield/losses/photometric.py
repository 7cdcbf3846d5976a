"""How far predicted images and depths are from measured ones."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sharpfield.core.frames import LEAST_DEPTH


def mse(predicted: Float[Tensor, "*b c"], measured: Float[Tensor, "*b c"]) -> Float[Tensor, ""]:
    """Mean squared difference over pixels and channels.

    Serves blurred pixels and targets from the event double integral alike.

    Args:
        predicted: In the encoding of `measured`.
        measured: As stored, usually 0...1; targets may exceed 1.
    """
    return (predicted - measured).square().mean()


def weighted_mse(
    predicted: Float[Tensor, "b c"],
    measured: Float[Tensor, "b c"],
    weight: Float[Tensor, "b"],
    counted: Bool[Tensor, "b"],
) -> Float[Tensor, ""]:
    """Mean over the pixels that count of their squared difference, times a weight of each."""
    error = (predicted - measured).square().mean(-1) * weight * counted
    return error.sum() / counted.sum().clamp_min(1)


def l1(predicted: Float[Tensor, "*b c"], measured: Float[Tensor, "*b c"]) -> Float[Tensor, ""]:
    """Mean absolute difference over pixels and channels."""
    return (predicted - measured).abs().mean()


def relative_depth_error(
    predicted: Float[Tensor, "*b"], measured: Float[Tensor, "*b"]
) -> Float[Tensor, ""]:
    """Mean relative error of depth over pixels with a measurement, each at most 1.

    Args:
        predicted: In the unit of `measured`.
        measured: 0 where it is unknown.
    """
    known = measured > 0
    off = (predicted - measured).abs() / measured.clamp_min(LEAST_DEPTH)
    # Clamped: a larger error means that one of the two looks past an edge.
    return torch.where(known, off.clamp_max(1), 0).sum() / known.sum().clamp_min(1)
