"""Event camera response functions: linear RGB to the log of a photoreceptor's output.

A response is called with the light of the rays of some event pairs and with the pairs themselves,
because a pixel may be behind a colour filter and a learned response may read the events' signs. All
responses are interchangeable.

Vocabulary: a mono pixel measures *luma*, the weighted sum of three colours; a pixel behind a Bayer
filter measures one *channel*. `floor` is linear light added before the logarithm; it models the
dark current of a real photoreceptor and keeps the logarithm finite.

The network of `LearnedResponse` is first fitted to the identity, sigmoid(x + step MLP(x)) = x for x
in 0...1, by 3000 steps of Adam (`fit_identity`). Its derivatives are written out in numpy: for a
network of 600 numbers, automatic differentiation would spend nearly all its time on bookkeeping.

Sources: Ev-DeblurNeRF (CVPR 2024), event camera response function, and its released code; EventNeRF
(CVPR 2023), Bayer colour; ITU-R BT.601, luma.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.measurements import EventPairs
from sharpfield.core.tone import Curve, identity, luma
from sharpfield.ops.dense import Dense, linear

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
            zero here, so their effect is left as it was.
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


FLOOR = 1e-5

START_SEED = 12
"""Seed of the learned curve's initial parameters.

How close the fitted curve comes to the identity depends on them: of seeds 0 to 31, half end with
phi(0) = 0.08 or more; this one is among the closest, for either polarity too.
"""

Inputs = Literal["light", "light+polarity"]
"""Inputs of a learned response: light alone, or also the pair's counts of each sign."""


def passed(light: Float[Tensor, "b k c"], seen: EventPairs) -> Float[Tensor, "b k d"]:
    """The colours that pass a pixel's filter: one (d = 1) on a Bayer sensor, else all (d = c)."""
    if seen.channel is None or light.shape[-1] == 1:
        return light
    channel = seen.channel[:, None, None].expand(*light.shape[:2], 1)
    return light.gather(-1, channel)


@dataclass(frozen=True)
class FixedResponse:
    """A known curve on each colour, then luma, then the logarithm."""

    curve: Curve = identity
    """`identity` where events follow linear light, `gamma` where they follow stored values."""
    floor: float = FLOOR

    def __call__(self, light: Float[Tensor, "b k c"], seen: EventPairs) -> Float[Tensor, "b k 1"]:
        """log(luma(curve(light)) + floor)."""
        return (luma(self.curve(passed(light, seen)))[..., None] + self.floor).log()


class LearnedResponse(nn.Module):
    """The published curve: phi(x) = sigmoid(x + 0.1 MLP(x, negative, positive)) on each colour.

    One network of widths 16, 16, 16 serves all colours, followed by luma and the logarithm. It
    starts near the identity, to which it is fitted, but keeps a floor near black. `LogResidual`
    starts there exactly.

    On a Bayer sensor only the pixel's own colour counts, so only that one is computed; the
    published rule that the other two read zero polarities is met by leaving them out.

    Args:
        inputs: Whether the network also reads the pair's signed counts of events.
        polarity_start: The released code fits the identity for pairs without events and leaves
            the first weights of the counts `random`, so that the curve of any real pair starts
            somewhere else; `zero` makes it start near the identity for all.
        floor: Linear; added before the logarithm.
        steps: Of fitting the identity; about 0.15 ms each.
    """

    WIDTHS = (16, 16, 16)
    STEP = 0.1

    def __init__(
        self,
        *,
        inputs: Inputs = "light+polarity",
        polarity_start: Literal["zero", "random"] = "zero",
        floor: float = FLOOR,
        steps: int = 3000,
    ) -> None:
        super().__init__()
        self.floor = floor
        self.features = _features(inputs)
        first = torch.Generator().manual_seed(START_SEED)
        self.network = Dense([self.features, *self.WIDTHS, 1], generator=first)
        if polarity_start == "zero":
            nn.init.zeros_(next(self.network.parameters())[:, 1:])
        draws = torch.Generator().manual_seed(42)
        fit_identity(self.network, step=self.STEP, generator=draws, steps=steps)

    def forward(self, light: Float[Tensor, "b k c"], seen: EventPairs) -> Float[Tensor, "b k 1"]:
        """log(luma(phi(light)) + floor)."""
        return (luma(self.curve(passed(light, seen), seen))[..., None] + self.floor).log()

    def curve(self, light: Float[Tensor, "b k d"], seen: EventPairs) -> Float[Tensor, "b k d"]:
        """The curve phi itself, 0...1."""
        read = _read(light, seen, self.features)  # [b, k, d, features]
        return torch.sigmoid(light + self.STEP * self.network(read)[..., 0])


class LogResidual(nn.Module):
    """The exact logarithm plus a learned change: log(x + floor) + h(log(x + floor), polarity).

    `h` is a single layer of soft steps whose heights start at zero, so that the response starts as
    the logarithm of luma, or of the pixel's own colour, exactly and for any polarity. Bounding its
    slope below 1 keeps the whole response rising with light.

    Args:
        inputs: Whether `h` also reads the pair's signed counts of events.
        width: Number of soft steps.
        slope: Largest slope of `h` against log light. None leaves it free.
        floor: Linear; added before the logarithm.
        generator: Where the steps' first places come from.
    """

    def __init__(
        self,
        *,
        inputs: Inputs = "light+polarity",
        width: int = 16,
        slope: float | None = 0.9,
        floor: float = FLOOR,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.floor, self.slope = floor, slope
        self.features = _features(inputs)
        self.stretch = 2 / abs(math.log(floor))  # floor...1 becomes -1...1
        self.steps = linear(self.features, width, generator=generator)
        self.heights = nn.Parameter(torch.zeros(width))

    def forward(self, light: Float[Tensor, "b k c"], seen: EventPairs) -> Float[Tensor, "b k 1"]:
        """log(x + floor) + h(log(x + floor), polarity), x the light that reaches the pixel."""
        log = (luma(passed(light, seen))[..., None] + self.floor).log()
        read = _read(1 + self.stretch * log, seen, self.features)  # [b, k, 1, features]
        return log + self.steps(read).tanh() @ self._bounded_heights()

    def _bounded_heights(self) -> Float[Tensor, "f"]:
        if self.slope is None:
            return self.heights
        rise = (self.stretch * self.steps.weight[:, 0] * self.heights).abs().sum()
        return self.heights * (self.slope / rise.clamp_min(self.slope))


def _features(inputs: Inputs) -> int:
    return {"light": 1, "light+polarity": 3}[inputs]


def _read(
    value: Float[Tensor, "b k d"], seen: EventPairs, features: int
) -> Float[Tensor, "b k d f"]:
    """Each value as the network's input, with its pair's counts where they are read."""
    if features == 1:
        return value[..., None]
    counts = torch.stack([seen.negative, seen.positive], -1)[:, None, None, :]
    return torch.cat([value[..., None], counts.expand(*value.shape, 2)], -1)
