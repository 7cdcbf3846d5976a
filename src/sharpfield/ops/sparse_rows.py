"""Indexing of rows of a large table, with a sparse gradient.

The gradient of indexing a tensor is a dense tensor as large as the whole. Here it is a sparse
tensor of the indexed rows only, so that neither memory nor an optimizer with support for it
(`training.optim.RowAdam`) touches the others.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable


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
