"""Neural points: a point cloud with learned attributes.

A *neural point* has a fixed position and learned *attributes*: a *descriptor*, which is the input
of networks, a *confidence* that it is on a surface, a colour, and the direction from which it was
first seen. Colours are stored values, not light.

Source: Point-NeRF (CVPR 2022), section 3; attributes as in the released code of Hybrid Neural
Rendering (CVPR 2023).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Generator, Tensor, nn

from sharpfield.ops.knn import Cells, sort_into_cells
from sharpfield.ops.sparse_rows import take_rows

LEAST_CONFIDENCE = 1e-4
"""Confidences are clamped to at least this and at most 1 where used; their gradients pass."""


@dataclass(frozen=True)
class Attributes:
    """Attributes of some points."""

    descriptors: Float[Tensor, "n f"]
    confidence: Float[Tensor, "n 1"]
    """Clamped."""
    colours: Float[Tensor, "n c"]
    directions: Float[Tensor, "n 3"]


class NeuralPoints(nn.Module):
    """Neural points, one row for each in every tensor.

    Args:
        positions: In world units.
        descriptors: Of any width.
        confidence: 0...1.
        colours: 1 or 3 channels, as frames store them.
        directions: Unit vectors from a camera to each point.
        cell: Edge of the cells in which neighbours are looked up.
    """

    positions: Tensor

    def __init__(
        self,
        positions: Float[Tensor, "n 3"],
        descriptors: Float[Tensor, "n f"],
        confidence: Float[Tensor, "n 1"],
        colours: Float[Tensor, "n c"],
        directions: Float[Tensor, "n 3"],
        *,
        cell: float,
    ) -> None:
        super().__init__()
        self.register_buffer("positions", positions)
        self.descriptors = nn.Parameter(descriptors)
        self.confidence = nn.Parameter(confidence)
        self.colours = nn.Parameter(colours)
        self.directions = nn.Parameter(directions)
        self.cell = cell
        self._sorted: tuple[tuple[int, int, int], Cells] | None = None

    @classmethod
    def start(
        cls,
        positions: Float[Tensor, "n 3"],
        colours: Float[Tensor, "n c"],
        directions: Float[Tensor, "n 3"],
        *,
        channels: int,
        cell: float,
        generator: Generator,
        confidence: float = 1.0,
        spread: float = 0.5,
    ) -> "NeuralPoints":
        """Points whose descriptors are uniform from -`spread` to `spread`."""
        count = len(positions)
        descriptors = spread * (2 * torch.rand(count, channels, generator=generator) - 1)
        sure = torch.full((count, 1), confidence)
        return cls(positions, descriptors, sure, colours, directions, cell=cell)

    def __len__(self) -> int:
        """Number of points."""
        return len(self.positions)

    def cells(self) -> Cells:
        """The cell lists for neighbour queries, rebuilt when the points have changed."""
        held = self.positions
        stamp = (held.data_ptr(), held._version, len(held))
        if self._sorted is None or self._sorted[0] != stamp:
            self._sorted = stamp, sort_into_cells(held, self.cell)
        return self._sorted[1]

    def take(self, rows: Int64[Tensor, "m"]) -> Attributes:
        """The attributes of some points; ascending, without repetition."""
        confidence = take_rows(self.confidence, rows)
        bounded = confidence.detach().clamp(LEAST_CONFIDENCE, 1)
        return Attributes(
            take_rows(self.descriptors, rows),
            bounded + confidence - confidence.detach(),  # gradients pass the bounds
            take_rows(self.colours, rows),
            take_rows(self.directions, rows),
        )

    def points(self) -> dict[str, Tensor]:
        """All parameters and buffers with one row for each point, by name."""
        return {"positions": self.positions, **dict(self.named_parameters())}

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Replace all points, by any number of others; all parameters are new objects.

        Args:
            points: By the names of `points`, with the same rows.
        """
        for name, values in points.items():
            if name == "positions":
                self.positions = values
                continue
            learns = getattr(self, name).requires_grad
            setattr(self, name, nn.Parameter(values.detach(), requires_grad=learns))
