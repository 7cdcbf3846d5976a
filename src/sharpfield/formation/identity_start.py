"""Makes the published response curve start near the identity, before training.

The network of `LearnedResponse` is fitted to sigmoid(x + step MLP(x)) = x for x in 0...1 by 3000
steps of Adam. The derivatives are written out in numpy: on a network of 600 numbers nearly all
of the time of an automatic gradient would go into bookkeeping.

Source: released code of Ev-DeblurNeRF (CVPR 2024).
"""

import itertools

import numpy as np
import torch
from jaxtyping import Float

from sharpfield.ops.dense import Dense

BATCH = 64 * 3
RATE, BETA_1, BETA_2, EPSILON = 1e-2, 0.9, 0.999, 1e-8

Layers = list[tuple[np.ndarray, np.ndarray]]
"""Weights `[outputs, inputs]` and biases, as views of one flat array."""


def fit_identity(
    network: Dense, *, step: float, generator: torch.Generator, steps: int = 3000
) -> None:
    """Change a network, in place, so that sigmoid(x + step network(x)) is about x.

    Args:
        network: Layers with biases and ReLU between them; the first input is x. Further inputs are
            zero here, so what the network makes of them is left as it was.
        step: Factor on the network's output.
        generator: Draws x, uniform in 0...1.
        steps: Of Adam.
    """
    first, *rest = (parameter.detach() for parameter in network.parameters())
    fitted = [first[:, :1], *rest]  # weight, bias, weight, bias, ... of the layers
    flat = np.concatenate([part.flatten().double().numpy() for part in fitted])
    layers = _views(flat, [tuple(part.shape) for part in fitted])
    draws = torch.rand(steps, BATCH, 1, generator=generator, dtype=torch.float64).numpy()
    mean, square = np.zeros_like(flat), np.zeros_like(flat)
    for count, x in enumerate(draws, start=1):
        slope = _slope(layers, x, step)
        mean += (1 - BETA_1) * (slope - mean)
        square += (1 - BETA_2) * (slope * slope - square)
        size = np.sqrt(square / (1 - BETA_2**count)) + EPSILON
        flat -= RATE * (mean / (1 - BETA_1**count)) / size
    for part, values in zip(fitted, itertools.chain(*layers), strict=True):
        part.copy_(torch.as_tensor(values))


def _views(flat: Float[np.ndarray, "p"], shapes: list[tuple[int, ...]]) -> Layers:
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
    parts = [part.reshape(shape) for part, shape in zip(np.split(flat, ends), shapes, strict=True)]
    return list(zip(parts[::2], parts[1::2], strict=True))


def _slope(layers: Layers, x: Float[np.ndarray, "b 1"], step: float) -> Float[np.ndarray, "p"]:
    """Gradient of the mean of (sigmoid(x + step network(x)) - x)^2, in the order of the layers."""
    inputs = [x]  # of each layer, before its ReLU; x is not negative
    for weight, bias in layers:
        inputs.append(np.maximum(inputs[-1], 0) @ weight.T + bias)
    value = 1 / (1 + np.exp(-(x + step * inputs[-1])))
    back = step * 2 * (value - x) * value * (1 - value) / len(x)
    slopes: list[np.ndarray] = []
    for (weight, _), before in zip(reversed(layers), reversed(inputs[:-1]), strict=True):
        slopes += [back.sum(0), (back.T @ np.maximum(before, 0)).ravel()]
        back = (back @ weight) * (before > 0)
    return np.concatenate(slopes[::-1])
