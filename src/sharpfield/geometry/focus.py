"""The point that cameras look at."""

import numpy as np
from jaxtyping import Float

PARALLEL = 1e-3
"""Mean squared sine of the angles between optical axes, below which they meet nowhere."""


def focus(poses: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3"] | None:
    """The point nearest to all optical axes, in the least-squares sense.

    None if the axes are nearly parallel, or if most cameras look away from it.
    """
    centre, forward = poses[:, :, 3], poses[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # removes what is along an axis
    system = across.mean(0)
    if np.linalg.eigvalsh(system)[0] < PARALLEL:
        return None
    right = (across @ centre[..., None]).mean(0)[:, 0]
    point = np.asarray(np.linalg.solve(system, right), np.float64)  # pyright: ignore
    before = ((point - centre) * forward).sum(-1) > 0
    return point if before.mean() > 0.5 else None
