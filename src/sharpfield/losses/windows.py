"""How far predicted changes of log intensity are from events counted in windows of time.

Everything is in natural log. `measured` is the signed counts times their thresholds.

Source: EvDNeRF (WACV 2024) for the normalised error and the dead zone; Robust e-NeRF (ICCV 2023)
for errors in units of the threshold.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def scaled_error(
    predicted: Float[Tensor, "b"],
    measured: Float[Tensor, "b"],
    *,
    scale: float,
    measured_scale: float,
) -> Float[Tensor, ""]:
    """Mean squared difference of both divided by a scale of its own.

    With scales that differ, what is learned is log intensity times `scale / measured_scale`.
    """
    return (predicted / scale - measured / measured_scale).square().mean()


def dead_zone_error(
    predicted: Float[Tensor, "b"], measured: Float[Tensor, "b"], threshold: float
) -> Float[Tensor, ""]:
    """Mean squared distance from the middle of a zone one threshold wide; nothing inside it.

    The zone reaches from the measured change to one threshold further from zero, to brighter where
    nothing was measured. There the distance is that from zero, as published: a small change to
    darker costs, though it would not have made an event.
    """
    away = torch.where(measured < 0, -1.0, 1.0)
    beyond = (predicted - measured) * away
    inside = (beyond >= 0) & (beyond < threshold)
    middle = torch.where(measured == 0, measured, measured + away * threshold / 2)
    return ((predicted - middle).square() * ~inside).mean()


def exact_error(
    predicted: Float[Tensor, "b"], measured: Float[Tensor, "b"], threshold: Float[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Mean difference in thresholds where nothing is left over: squared up to one, then linear."""
    return _robust((predicted - measured).abs() / threshold).mean()


def counted_error(
    predicted: Float[Tensor, "b"],
    measured: Float[Tensor, "b"],
    threshold: Float[Tensor, "b"],
    *,
    pull: float = 0.0,
) -> Float[Tensor, ""]:
    """The same where less than one threshold is left over at either end of the windows.

    n more events to brighter than to darker say that the change is between n - 1 and n + 1
    thresholds. Inside, only `pull` of the difference counts.
    """
    off = (predicted - measured).abs() / threshold
    return (_robust((off - 1).clamp_min(0)) + pull * _robust(off)).mean()


def _robust(off: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """Huber's, times two."""
    return torch.where(off < 1, off.square(), 2 * off - 1)
