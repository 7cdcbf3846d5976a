"""How a set of points changes its number: which rows stay, which are copied, what starts anew.

A *point* is whatever a scene is made of and has one row in each of several tensors: a Gaussian, a
neural point. A *growth* says what the next set is made of in terms of the present one, so that
pruning, cloning, splitting and moving points are all the same operation.
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
    """Points the optimizer has never seen, whatever they are copied from."""
    values: dict[str, Float[Tensor, "m ..."]] = field(default_factory=dict[str, Tensor])
    """Tensors by name that are not just copied; rows that equal their source's are left alone."""

    def __len__(self) -> int:
        """Number of points afterwards."""
        return len(self.source)


def unchanged(count: int, device: torch.device | str = "cpu") -> Growth:
    """The growth that leaves everything as it is; give it `values` to set some of them."""
    every = torch.arange(count, device=device)
    return Growth(every, torch.zeros_like(every, dtype=torch.bool))
