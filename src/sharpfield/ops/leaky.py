"""Small networks with leaky activations, as Point-NeRF and its descendants have them.

Weights start by Xavier's rule, evenly distributed, with the gain of what follows them; biases start
at zero.
"""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.ops.dense import apply_linear

SLOPE = 0.01
"""Of the activation below zero."""

GAIN = nn.init.calculate_gain("leaky_relu", SLOPE)
"""Of weights that an activation follows."""


def leaky(x: Float[Tensor, "*b f"]) -> Float[Tensor, "*b f"]:
    """The activation."""
    return nn.functional.leaky_relu(x, SLOPE)


def xavier(layer: nn.Linear | nn.Conv2d, gain: float, generator: torch.Generator) -> None:
    """Give a layer its first parameters."""
    nn.init.xavier_uniform_(layer.weight, gain, generator=generator)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)


class LeakyLayers(nn.Module):
    """Linear layers with activations.

    They compute in the precision of their input; the parameters stay float32.

    Args:
        sizes: Widths from input to output.
        generator: Where the first parameters come from.
        ends: Whether an activation follows the last layer, too: `leaky`, or `linear` if not.
    """

    def __init__(
        self, sizes: Sequence[int], *, generator: torch.Generator, ends: str = "leaky"
    ) -> None:
        super().__init__()
        assert ends in ("leaky", "linear"), ends
        self.ends = ends
        self.layers = nn.ModuleList()
        for index, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
            layer = nn.Linear(inputs, outputs, device="meta").to_empty(device=generator.device)
            followed = ends == "leaky" or index < len(sizes) - 2
            xavier(layer, GAIN if followed else 1.0, generator)
            self.layers.append(layer)

    def forward(self, *parts: Float[Tensor, "*_b _f"]) -> Float[Tensor, "*b o"]:
        """Apply all layers to parts of an input that lie side by side."""
        hidden = self.first(*parts)
        if len(self.layers) == 1 and self.ends == "linear":
            return hidden
        return self.rest(leaky(hidden))

    def first(self, *parts: Float[Tensor, "*_b _f"], skipped: int = 0) -> Float[Tensor, "*b o"]:
        """What the first layer makes of some parts of its input, before the activation.

        A layer of parts is the sum of one layer for each of them: nothing is joined, and parts that
        many rows share are worked out once. The bias counts with the part that comes first.

        Args:
            parts: Lie side by side in the input.
            skipped: Features of the input before them.
        """
        layer = self.layers[0]
        assert isinstance(layer, nn.Linear)
        bias = None if skipped else layer.bias
        out: Tensor | None = None
        for part in parts:
            weight = layer.weight[:, skipped : skipped + part.shape[-1]]
            one = apply_linear(weight, bias, part)
            out = one if out is None else out + one
            bias, skipped = None, skipped + part.shape[-1]
        assert out is not None, "no parts"
        return out

    def rest(self, hidden: Float[Tensor, "*b h"]) -> Float[Tensor, "*b o"]:
        """The layers after the first, whose activation is behind us."""
        last = len(self.layers) - 1
        for index, layer in enumerate(self.layers):
            if index == 0:
                continue
            assert isinstance(layer, nn.Linear)
            hidden = apply_linear(layer.weight, layer.bias, hidden)
            if index < last or self.ends == "leaky":
                hidden = leaky(hidden)
        return hidden
