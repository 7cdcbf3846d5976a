"""Compositing on the CPU in one pass over each ray, forwards and backwards.

With e_j = exp(-density_j delta_j) the share of light that passes sample j, T_j the product of
(e_k + 1e-10) in front of it and g_j the gradient of its weight, the gradient of the optical depth
density_j delta_j is

    e_j T_j g_j - e_j / (e_j + 1e-10) sum_{k > j} g_k w_k.

Only `e` and the weights are kept for it; plain torch keeps six arrays of that size. A single thread
walks over the rays: they come in pieces that are done before another one is awake.
"""

from collections.abc import Callable
from typing import Any, no_type_check

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sharpfield.ops.compositing import LEAK, weigh
from sharpfield.ops.fast._kernel import kernel, memory


@weigh.accelerate("cpu", needs="numba")
def _(
    density: Float[Tensor, "*b s"], delta: Float[Tensor, "*b s"], *, opaque_end: bool = False
) -> Float[Tensor, "*b s"]:
    apply: Callable[..., Tensor] = _Weigh.apply  # pyright: ignore[reportUnknownMemberType]
    return apply(density, delta, opaque_end)


class _Weigh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, density: Tensor, delta: Tensor, opaque_end: bool) -> Tensor:
        clear = torch.exp(-density * delta)
        if opaque_end:
            clear[..., -1] = 0
        weights = torch.empty_like(clear)
        _forward(_rows(clear), _rows(weights))
        ctx.save_for_backward(density, delta, clear, weights)
        return weights

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None]:
        density, delta, clear, weights = ctx.saved_tensors
        of_depth = torch.empty_like(clear)
        arrived = gradients[0].contiguous()
        _backward(_rows(clear), _rows(weights), _rows(arrived), _rows(of_depth))
        return (
            of_depth * delta if ctx.needs_input_grad[0] else None,
            of_depth * density if ctx.needs_input_grad[1] else None,
            None,
        )


def _rows(values: Tensor) -> Any:
    return memory(values.reshape(-1, values.shape[-1]))


@kernel
@no_type_check
def _forward(clear, weights):
    leak = clear.dtype.type(LEAK)
    for i in range(clear.shape[0]):
        passed = clear.dtype.type(1)
        for j in range(clear.shape[1]):
            weights[i, j] = (1 - clear[i, j]) * passed
            passed *= clear[i, j] + leak


@kernel
@no_type_check
def _backward(clear, weights, gradient, of_depth):
    leak = clear.dtype.type(LEAK)
    for i in range(clear.shape[0]):
        behind = clear.dtype.type(0)
        for j in range(clear.shape[1] - 1, -1, -1):  # sums from the far end lose no digits
            of_depth[i, j] = -behind * clear[i, j] / (clear[i, j] + leak)
            behind += gradient[i, j] * weights[i, j]
        passed = clear.dtype.type(1)
        for j in range(clear.shape[1]):
            of_depth[i, j] += clear[i, j] * passed * gradient[i, j]
            passed *= clear[i, j] + leak
