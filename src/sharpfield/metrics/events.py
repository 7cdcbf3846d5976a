"""How well predicted events match measured ones, by their numbers at each pixel."""

from jaxtyping import Float
from torch import Tensor


def relative_count_error(
    predicted: Float[Tensor, "*b h w"], measured: Float[Tensor, "*b h w"]
) -> Float[Tensor, ""]:
    """Absolute differences of event counts as a share of all measured events.

    0 is perfect; 1 is what predicting no event at all gets. Infinite if nothing was measured.

    Args:
        predicted: Number of events at each pixel; give signs and time windows as leading axes,
            or errors of opposite sign hide each other.
        measured: The same for the recording.
    """
    return (predicted - measured).abs().sum() / measured.sum()
