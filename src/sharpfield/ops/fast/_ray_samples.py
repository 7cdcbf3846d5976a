# pyright: basic
"""The samples of a ray as marching kernels record them, their composite, and its gradient.

A ray has a table with a row for each sample: its number along the ray, its opacity (alpha), its
weight (the share of the ray's light that it contributes), the slope of softplus, and three colours.
"""

import math

import numpy as np
import torch

from sharpfield.ops.fast._kernel import kernel, share
from sharpfield.ops.voxel_march import DENSITY_SHIFT

PARTS = 2
"""Parts of the rays with a gradient sum of their own; a constant, so that sums do not depend on the
number of threads."""

MIN_TRANSMITTANCE = 1e-5
"""A ray ends when less than this share of light gets through."""

MIN_WEIGHT = 1e-7
"""The colour of a sample of smaller weight is not computed."""

COLUMNS = 7
"""Of the table of a ray."""


def sample_buffers(rays: int, samples: int, *, learning: bool) -> tuple[np.ndarray, np.ndarray]:
    """Memory for the samples of rays `[rays, samples, COLUMNS]`, and for how many each has.

    Without gradients one table for each worker is enough; every ray overwrites it.
    """
    count = rays if learning else torch.get_num_threads()
    return np.empty((count, samples, COLUMNS), np.float32), np.empty(rays, np.int64)


@kernel
def record(row, sample, values, transmittance):
    """Record a sample, given the interpolated grid values and the transmittance up to it.

    Returns the transmittance behind it.
    """
    raw = values[0] + DENSITY_SHIFT
    alpha = 1.0 - math.exp(-_softplus(raw))
    row[0], row[1], row[2], row[3] = sample, alpha, transmittance * alpha, _sigmoid(raw)
    _record_colour(row, values)
    return transmittance * (1.0 - alpha)


@kernel
def record_opaque_end(row, sample, values, transmittance):
    """Record a last sample, which absorbs all remaining light."""
    row[0], row[1], row[2], row[3] = sample, 1.0, transmittance, 0.0
    _record_colour(row, values)


@kernel
def _record_colour(row, values):
    if row[2] > MIN_WEIGHT:
        row[4], row[5], row[6] = _sigmoid(values[1]), _sigmoid(values[2]), _sigmoid(values[3])
    else:
        row[4] = row[5] = row[6] = 0.0


@kernel
def _softplus(raw):
    return raw if raw > 15.0 else math.log1p(math.exp(raw))


@kernel
def _sigmoid(raw):
    return 1.0 / (1.0 + math.exp(-raw))


@kernel
def composite(samples, count, depths, out):
    """Colour, depth and opacity of a ray; `depths` are those of all its samples."""
    red = green = blue = depth = opacity = 0.0
    for k in range(count):
        w = samples[k, 2]
        red += w * samples[k, 4]
        green += w * samples[k, 5]
        blue += w * samples[k, 6]
        depth += w * depths[int(samples[k, 0])]
        opacity += w
    out[0], out[1], out[2], out[3], out[4] = red, green, blue, depth, opacity


@kernel
def sample_gradient(row, depth, grad_out, behind, grad_values):
    """Gradient by the grid values at a sample, written to `grad_values`.

    `behind` is the sum over later samples of weight times contribution to the loss; returns that
    sum with this sample.
    """
    value = grad_out[0] * row[4] + grad_out[1] * row[5] + grad_out[2] * row[6]
    value += grad_out[3] * depth + grad_out[4]
    # d w_k / d tau = T_k e^-tau; every later weight falls in proportion.
    front = row[2] / row[1] if row[1] > 0.0 else 0.0
    grad_values[0] = row[3] * (front * (1.0 - row[1]) * value - behind)
    for c in range(3):
        grad_values[1 + c] = row[2] * grad_out[c] * row[4 + c] * (1.0 - row[4 + c])
    return behind + row[2] * value


@kernel
def add_parts(worker, workers, sums):
    """Add all parts `[p, n]` to the first."""
    first, last = share(worker, workers, sums.shape[1])
    for part in range(1, len(sums)):
        for i in range(first, last):
            sums[0, i] += sums[part, i]
