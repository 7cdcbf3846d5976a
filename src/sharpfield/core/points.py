"""Growth of a set of points: which rows are kept, copied or new.

A *point* is an element of a scene with one row in each of several tensors: a Gaussian, a neural
point. A *growth* describes the next set in terms of the present one, so that pruning, cloning,
splitting and relocating points are all the same operation.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor


@dataclass(frozen=True)
class Growth:
    """The next set of m points, made from the present one of n."""

    source: Int64[Tensor, "m"]
    """The row that each point is a copy of."""
    fresh: Bool[Tensor, "m"]
    """Points whose optimizer state is reset."""
    values: dict[str, Float[Tensor, "m ..."]] = field(default_factory=dict[str, Tensor])
    """Tensors by name that are not just copied; rows equal to their source's stay as they are."""

    def __len__(self) -> int:
        """Number of points afterwards."""
        return len(self.source)


def unchanged(count: int, device: torch.device | str = "cpu") -> Growth:
    """The growth that changes nothing; give it `values` to set some of them."""
    every = torch.arange(count, device=device)
    return Growth(every, torch.zeros_like(every, dtype=torch.bool))
