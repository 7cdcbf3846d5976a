"""How far predicted images are from measured ones."""

from jaxtyping import Float
from torch import Tensor


def mse(predicted: Float[Tensor, "*b c"], measured: Float[Tensor, "*b c"]) -> Float[Tensor, ""]:
    """Mean squared difference over pixels and channels.

    Serves blurred pixels and the prior from the event double integral alike.

    Args:
        predicted: In the encoding of `measured`.
        measured: As stored, usually 0...1; a prior may exceed 1.
    """
    return (predicted - measured).square().mean()
