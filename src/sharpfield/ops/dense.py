"""Small networks: layers with skips, a first layer split in two, a learned vector per frame.

Every parameter comes from an explicit generator; the default is PyTorch's own rule for linear
layers, weights and biases uniform in +-1/sqrt(inputs).
"""

import itertools
import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

Activation = Callable[[Tensor], Tensor]


def linear(
    inputs: int, outputs: int, *, generator: torch.Generator, bias: bool = True
) -> nn.Linear:
    """A linear layer with PyTorch's default initialisation, drawn from `generator`."""
    layer = nn.Linear(inputs, outputs, bias=bias, device="meta")  # draws nothing
    layer = layer.to_empty(device=generator.device)
    bound = 1 / math.sqrt(inputs)
    for parameter in layer.parameters():
        nn.init.uniform_(parameter, -bound, bound, generator=generator)
    return layer


class Dense(nn.Module):
    """Linear layers with an activation between them and none after the last.

    They compute in the precision of their input; the parameters stay float32.

    Args:
        sizes: Widths from input to output, e.g. `[63, 256, 256, 4]` for three layers.
        generator: Where the first parameters come from.
        bias: Whether layers have one.
        activation: Between layers.
        skips: The input is appended again to the input of these layers; layer 0 is the first.
            The network of NeRF is `sizes=[63] + 8 * [256]`, `skips=(5,)`.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        generator: torch.Generator,
        bias: bool = True,
        activation: Activation = torch.relu,
        skips: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.activation = activation
        self.skips = frozenset(skips)
        self.layers = nn.ModuleList(
            linear(
                inputs + sizes[0] * (index in self.skips), outputs, generator=generator, bias=bias
            )
            for index, (inputs, outputs) in enumerate(itertools.pairwise(sizes))
        )

    def forward(self, x: Float[Tensor, "*b i"]) -> Float[Tensor, "*b o"]:
        """Apply all layers."""
        hidden = x
        for index, layer in enumerate(self.layers):
            if index:
                hidden = self.activation(hidden)
            if index in self.skips:
                hidden = torch.cat([x, hidden], -1)
            assert isinstance(layer, nn.Linear)
            hidden = apply_linear(layer.weight, layer.bias, hidden)
        return hidden


def apply_linear(
    weight: Float[Tensor, "o i"], bias: Float[Tensor, "o"] | None, x: Float[Tensor, "*b i"]
) -> Float[Tensor, "*b o"]:
    """A linear layer in the precision of its input; its parameters stay as they are."""
    bias = None if bias is None else bias.to(x.dtype)
    return nn.functional.linear(x, weight.to(x.dtype), bias)


class SplitLinear(nn.Module):
    """A linear layer whose input is [features of a sample, features of its ray].

    Equal to concatenating the two, but the ray's part is computed once per ray and added to every
    sample of it: nothing is repeated and nothing is joined.

    Args:
        per_sample: Width of the samples' features.
        per_ray: Width of the ray's features, e.g. the encoding of its direction.
        outputs: Width of the result.
        generator: Where the first parameters come from.
        bias: Whether the layer has one.
    """

    def __init__(
        self,
        per_sample: int,
        per_ray: int,
        outputs: int,
        *,
        generator: torch.Generator,
        bias: bool = True,
    ) -> None:
        super().__init__()
        joined = linear(per_sample + per_ray, outputs, generator=generator, bias=bias)
        self.of_sample = nn.Parameter(joined.weight.detach()[:, :per_sample].clone())
        self.of_ray = nn.Parameter(joined.weight.detach()[:, per_sample:].clone())
        self.bias = joined.bias

    def forward(
        self, sample: Float[Tensor, "*b s i"], ray: Float[Tensor, "*b j"]
    ) -> Float[Tensor, "*b s o"]:
        """W_sample sample + (W_ray ray + bias), the latter shared along a ray."""
        shared = apply_linear(self.of_ray, self.bias, ray)
        return apply_linear(self.of_sample, None, sample) + shared[..., None, :]


class FrameVectors(nn.Module):
    """One learned vector for each frame; all start at zero, so all frames start alike."""

    def __init__(self, frames: int, width: int) -> None:
        super().__init__()
        self.vectors = nn.Parameter(torch.zeros(frames, width))

    def forward(self, frame: Int[Tensor, "*b"]) -> Float[Tensor, "*b f"]:
        """The vectors of the given frames."""
        return self.vectors[frame]
