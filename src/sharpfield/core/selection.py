"""Some of many."""

import numpy as np
from jaxtyping import Shaped


def evenly_spread(rows: Shaped[np.ndarray, "n *_"], most: int) -> Shaped[np.ndarray, "m *_"]:
    """At most `most` rows in their order, evenly spread: all, or the first, the last, and between.

    Args:
        rows: Of any kind.
        most: How many; a single one is the first.
    """
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]
