"""Small MLPs, a learned vector per frame, and rows of a large table with a sparse gradient.

All initial parameters come from an explicit generator. `linear` and `Dense` use PyTorch's default
for linear layers, weights and biases uniform in +-1/sqrt(inputs); `LeakyLayers`, as in Point-NeRF
and its successors, uniform Xavier weights with the gain of the activation, and zero biases.

The gradient of indexing a tensor is dense and as large as the whole. That of `take_rows` is a
sparse tensor of the indexed rows only, so that neither memory nor an optimizer with support for it
(`training.optim.RowAdam`) touches the others.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

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
        generator: Draws the initial parameters.
        bias: Whether layers have one.
        activation: Between layers.
        skips: The input is concatenated again to the input of these layers; layer 0 is the first.
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

    Equal to a layer of the concatenated input, but the ray's part is computed once per ray and
    added to each of its samples, so that nothing is repeated or copied.

    Args:
        per_sample: Width of the samples' features.
        per_ray: Width of the ray's features, e.g. the encoding of its direction.
        outputs: Width of the result.
        generator: Draws the initial parameters.
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


SLOPE = 0.01
"""Of the activation below zero."""

GAIN = nn.init.calculate_gain("leaky_relu", SLOPE)
"""Xavier gain of layers that are followed by the activation."""


def leaky(x: Float[Tensor, "*b f"]) -> Float[Tensor, "*b f"]:
    """The activation."""
    return nn.functional.leaky_relu(x, SLOPE)


def xavier(layer: nn.Linear | nn.Conv2d, gain: float, generator: torch.Generator) -> None:
    """Set the initial parameters of a layer."""
    nn.init.xavier_uniform_(layer.weight, gain, generator=generator)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)


class LeakyLayers(nn.Module):
    """Linear layers with activations.

    They compute in the precision of their input; the parameters stay float32.

    Args:
        sizes: Widths from input to output.
        generator: Draws the initial parameters.
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
        """Apply all layers to the concatenation of parts of an input."""
        hidden = self.first(*parts)
        if len(self.layers) == 1 and self.ends == "linear":
            return hidden
        return self.rest(leaky(hidden))

    def first(self, *parts: Float[Tensor, "*_b _f"], skipped: int = 0) -> Float[Tensor, "*b o"]:
        """The first layer for some parts of its input, before the activation.

        A layer of a concatenation is the sum of one layer for each part: nothing is copied, and
        parts that many rows share are computed once. The bias is added with the first part.

        Args:
            parts: Consecutive parts of the input.
            skipped: Number of input features before them.
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
        """The layers after the first, whose activation was already applied."""
        last = len(self.layers) - 1
        for index, layer in enumerate(self.layers):
            if index == 0:
                continue
            assert isinstance(layer, nn.Linear)
            hidden = apply_linear(layer.weight, layer.bias, hidden)
            if index < last or self.ends == "leaky":
                hidden = leaky(hidden)
        return hidden


def take_rows(table: Float[Tensor, "n f"], rows: Int64[Tensor, "m"]) -> Float[Tensor, "m f"]:
    """Rows of a table, with a sparse gradient.

    Args:
        table: Of any length.
        rows: Ascending, without repetition, see `compact`.
    """
    apply: Callable[..., Tensor] = _TakeRows.apply  # pyright: ignore
    return apply(table, rows)


def compact(rows: Int64[Tensor, "*b"]) -> tuple[Int64[Tensor, "m"], Int64[Tensor, "*b"]]:
    """The rows that occur, ascending and once each, and where in that list each one is."""
    unique: Callable[..., tuple[Tensor, Tensor]] = torch.unique  # pyright: ignore
    return unique(rows, return_inverse=True)


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = table.shape
        return table.index_select(0, rows)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        sparse: Callable[..., Tensor] = torch.sparse_coo_tensor  # pyright: ignore
        shape = ctx.shape
        taken = sparse(rows[None], gradients[0], shape, is_coalesced=True, check_invariants=False)
        return taken, None
