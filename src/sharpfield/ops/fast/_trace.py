# pyright: basic
"""What marching kernels note of the samples that a ray meets, and what follows from these notes.

The *trace* of a ray has a row for each sample: its number along the ray, its opacity, its share of
the ray's light (its *weight*), the slope of softplus, and three colours.
"""

import math

import numpy as np
import torch

from sharpfield.ops.fast._kernel import kernel, share
from sharpfield.ops.voxel_march import THIN

PARTS = 2
"""Shares of the rays with a gradient of their own; a constant, so that sums do not depend on the
number of threads."""

DARK = 1e-5
"""A ray ends when less than this share of light gets through."""

FAINT = 1e-7
"""The colour of a sample with a smaller share of the ray's light is not computed."""

COLUMNS = 7
"""Of a trace."""


def room_for_traces(rays: int, samples: int, *, learning: bool) -> tuple[np.ndarray, np.ndarray]:
    """Room for the traces of rays, and for how many samples each has.

    Without gradients one trace for each worker is enough, written over by every ray.
    """
    count = rays if learning else torch.get_num_threads()
    return np.empty((count, samples, COLUMNS), np.float32), np.empty(rays, np.int64)


@kernel
def note(row, sample, found, clear):
    """Note a sample, given what the grids hold there and how much light gets to it.

    Returns how much light gets through.
    """
    raw = found[0] + THIN
    alpha = 1.0 - math.exp(-_softplus(raw))
    row[0], row[1], row[2], row[3] = sample, alpha, clear * alpha, _sigmoid(raw)
    _note_colour(row, found)
    return clear * (1.0 - alpha)


@kernel
def note_end(row, sample, found, clear):
    """Note a last sample, which stops all light."""
    row[0], row[1], row[2], row[3] = sample, 1.0, clear, 0.0
    _note_colour(row, found)


@kernel
def _note_colour(row, found):
    if row[2] > FAINT:
        row[4], row[5], row[6] = _sigmoid(found[1]), _sigmoid(found[2]), _sigmoid(found[3])
    else:
        row[4] = row[5] = row[6] = 0.0


@kernel
def _softplus(raw):
    return raw if raw > 15.0 else math.log1p(math.exp(raw))


@kernel
def _sigmoid(raw):
    return 1.0 / (1.0 + math.exp(-raw))


@kernel
def gather(trace, kept, place, out):
    """Colour, depth and opacity of a ray; `place` is where its samples are."""
    red = green = blue = depth = opacity = 0.0
    for k in range(kept):
        w = trace[k, 2]
        red += w * trace[k, 4]
        green += w * trace[k, 5]
        blue += w * trace[k, 6]
        depth += w * place[int(trace[k, 0])]
        opacity += w
    out[0], out[1], out[2], out[3], out[4] = red, green, blue, depth, opacity


@kernel
def slopes(row, z, wanted, behind, slope):
    """How the loss grows with what the grids hold at a sample at `z`, into `slope`.

    `behind` is the sum over later samples of weight times what it adds to the loss; returns that
    sum with this sample.
    """
    value = wanted[0] * row[4] + wanted[1] * row[5] + wanted[2] * row[6] + wanted[3] * z + wanted[4]
    # d w_k / d tau = T_k e^-tau; every later weight falls in proportion.
    front = row[2] / row[1] if row[1] > 0.0 else 0.0
    slope[0] = row[3] * (front * (1.0 - row[1]) * value - behind)
    for c in range(3):
        slope[1 + c] = row[2] * wanted[c] * row[4 + c] * (1.0 - row[4 + c])
    return behind + row[2] * value


@kernel
def merge(worker, workers, sums):
    """Add all parts `[p, n]` to the first."""
    first, last = share(worker, workers, sums.shape[1])
    for part in range(1, len(sums)):
        for i in range(first, last):
            sums[0, i] += sums[part, i]
