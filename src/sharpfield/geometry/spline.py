"""Curves through or near poses and points.

`cubic_coefficients` is the interpolating cubic of numerical textbooks (not-a-knot ends);
`bspline` is the cumulative cubic B-spline on SE(3) (Sommer et al., CVPR 2020, eq. 21).
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.geometry import se3


def cubic_coefficients(
    times: Float[np.ndarray, "p"], values: Float[np.ndarray, "p d"]
) -> Float[np.ndarray, "q 4 d"]:
    """Coefficients of the interpolating cubic spline, one row of four per segment.

    The third derivative is continuous at the second and last but one knot ("not a knot"). Three
    points give the parabola, two a line, one a constant.

    Args:
        times: Strictly ascending.
        values: That the curve passes through.

    Returns:
        c such that the value at `times[i] + s` is c[i,0] + c[i,1] s + c[i,2] s^2 + c[i,3] s^3.
    """
    count = len(times)
    if count == 1:
        flat = np.zeros((1, 4, values.shape[1]))
        flat[:, 0] = values
        return flat
    h = np.diff(times)[:, None]
    slope = np.diff(values, axis=0) / h
    bend = _second_derivatives(h, slope) if count > 2 else np.zeros_like(values)
    linear = slope - h * (2 * bend[:-1] + bend[1:]) / 6
    cubic = np.diff(bend, axis=0) / (6 * h)
    return np.stack([values[:-1], linear, bend[:-1] / 2, cubic], 1)


def _second_derivatives(
    h: Float[np.ndarray, "q 1"], slope: Float[np.ndarray, "q d"]
) -> Float[np.ndarray, "p d"]:
    """Solve the tridiagonal system of a not-a-knot spline for second derivatives at the knots."""
    count = len(h) + 1
    bend = np.zeros((count, slope.shape[1]))
    if count == 3:
        bend[:] = 2 * (slope[1] - slope[0]) / (h[0] + h[1])
        return bend
    below, diagonal, above = h[:-1].copy(), 2 * (h[:-1] + h[1:]), h[1:].copy()
    right = 6 * np.diff(slope, axis=0)
    # The end conditions express the outer two unknowns by their neighbours.
    diagonal[0] += h[0] * (1 + h[0] / h[1])
    above[0] -= h[0] * h[0] / h[1]
    diagonal[-1] += h[-1] * (1 + h[-1] / h[-2])
    below[-1] -= h[-1] * h[-1] / h[-2]
    for i in range(1, count - 2):  # Thomas algorithm: forward elimination, then substitution
        factor = below[i] / diagonal[i - 1]
        diagonal[i] -= factor * above[i - 1]
        right[i] -= factor * right[i - 1]
    inner = bend[1:-1]
    inner[-1] = right[-1] / diagonal[-1]
    for i in range(count - 4, -1, -1):
        inner[i] = (right[i] - above[i] * inner[i + 1]) / diagonal[i]
    bend[0] = bend[1] * (1 + h[0] / h[1]) - bend[2] * h[0] / h[1]
    bend[-1] = bend[-2] * (1 + h[-1] / h[-2]) - bend[-3] * h[-1] / h[-2]
    return bend


def bspline_weights(u: Float[Tensor, "*b"]) -> Float[Tensor, "*b 4"]:
    """Weights of four neighbouring knots in a uniform cubic B-spline; they sum to one.

    Args:
        u: Position between the middle two knots, 0...1.
    """
    u2, u3 = u * u, u * u * u
    return (
        torch.stack([(1 - u) ** 3, 3 * u3 - 6 * u2 + 4, -3 * u3 + 3 * u2 + 3 * u + 1, u3], -1) / 6
    )


def bspline(knots: Float[Tensor, "*b 4 3 4"], u: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3 4"]:
    """Pose on a cumulative cubic B-spline between the middle two of four knots."""
    weights = bspline_weights(u)
    cumulative = weights.flip(-1).cumsum(-1).flip(-1)  # [*b, 4]; the first is 1
    steps = se3.log(se3.compose(se3.inverse(knots[..., :-1, :, :]), knots[..., 1:, :, :]))
    pose = knots[..., 0, :, :]
    for j in range(3):
        pose = se3.compose(pose, se3.exp(cumulative[..., j + 1, None] * steps[..., j, :]))
    return pose
